"""`sweep_without_touching`: sweep some of the small blocks into a U-shaped area, around a line at its mouth.

Scene:    one to three blocks to sweep, as many of another texture, the area open towards the blocks, a line
          across its mouth.
Prompt:   "Sweep two {swept_obj} into {bounds} without touching {constraint}."
Success:  exactly the requested number is in the area, while no such block ever touched the line and no other
          block is there. "Any" means one, "all" all of one texture. What bounds the area is drawn, not solid.
Source:   VIMA paper, task list of the appendix, "Visual constraint satisfaction".
"""

from openvima.scene import Problem, Zone
from openvima.tasks.options import Difficulty, SomeDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.sweep_table import Layout, place_flat, sweep_problem
from openvima.tasks.table import TableSampler

TEMPLATE = "Sweep {det} {swept_obj} into {bounds} without touching {constraint}."
AREA_X = 0.39  # m, centre of the area
AREA_SCALE = (0.86, 1.5)
LINE_X = 0.496  # m, just outside the mouth
LINE_SCALE = {"easy": (0.75, 1.0), "medium": (1.35, 1.0), "hard": (1.85, 1.0)}
DISTRACTOR_SPREAD_M = 0.18


@register_task(
    "sweep_without_touching",
    family="visual_constraint_satisfaction",
    template=TEMPLATE,
    end_effector="spatula",
    oracle_max_steps=14,
)
def sample(
    table: TableSampler, *, num_distractors: SomeDistractors = None, difficulty: Difficulty = "easy"
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Blocks of another texture, 0 … 6; by default as many as blocks to sweep.
        difficulty: "easy": the line leaves gaps on both sides of the mouth; "medium" and "hard": it is
            wider than the mouth, and two or three blocks are more frequent.
    """

    def lay_out(bounds_texture: str, line_texture: str) -> Layout:
        bounds = place_flat(table, table.pool.base_objects[0], bounds_texture, x=AREA_X, scale=AREA_SCALE)
        line = place_flat(table, "line", line_texture, x=LINE_X, scale=LINE_SCALE[difficulty])
        return bounds, line, Zone(AREA_X, 0.0, *bounds.size[:2]), bounds

    return sweep_problem(
        table,
        TEMPLATE,
        difficulty=difficulty,
        num_distractors=num_distractors,
        lay_out=lay_out,
        distractor_spread_m=DISTRACTOR_SPREAD_M,
    )
