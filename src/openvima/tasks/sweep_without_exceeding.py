"""`sweep_without_exceeding`: sweep some of the small blocks into a U-shaped area, but not over a line in it.

Scene:    one to three blocks to sweep, as many of another texture, the area open towards the blocks, a line.
Prompt:   "Sweep two {swept_obj} into {bounds} without exceeding {constraint}."
Success:  exactly the requested number is between the line and the mouth of the area, while no such block ever
          touched the line and no other block is there. "Any" means one, "all" all of one texture.
Source:   VIMA paper, task list of the appendix, "Visual constraint satisfaction".
"""

from openvima.scene import Placement, Problem, Zone
from openvima.tasks.options import Difficulty, SomeDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.sweep_table import Layout, place_flat, sweep_problem
from openvima.tasks.table import TableSampler

TEMPLATE = "Sweep {det} {swept_obj} into {bounds} without exceeding {constraint}."
AREA_X = 0.41  # m, centre of the area
AREA_SCALE, LINE_SCALE = (1.35, 1.35), (1.35, 1.0)
LINE_RANGE = (0.25, 0.6)  # position of the line, as fractions of the area's depth from its back
ZONE_SHIFT_M = 0.015  # of the zone towards the blocks, against what is drawn; published results depend on it
DISTRACTOR_SPREAD_M = 0.09


@register_task(
    "sweep_without_exceeding",
    family="visual_constraint_satisfaction",
    template=TEMPLATE,
    end_effector="spatula",
    oracle_max_steps=8,
)
def sample(
    table: TableSampler, *, num_distractors: SomeDistractors = None, difficulty: Difficulty = "easy"
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Blocks of another texture, 0 … 6; by default as many as blocks to sweep.
        difficulty: "easy", "medium" or "hard": more and more often two or three blocks.
    """

    def lay_out(bounds_texture: str, line_texture: str) -> Layout:
        bounds = place_flat(table, table.pool.base_objects[0], bounds_texture, x=AREA_X, scale=AREA_SCALE)
        low, high = (AREA_X + (fraction - 0.5) * bounds.size[0] for fraction in LINE_RANGE)
        line = place_flat(table, "line", line_texture, x=table.rng.uniform(low, high), scale=LINE_SCALE)
        return bounds, line, _zone_in_front(line, bounds), line

    return sweep_problem(
        table,
        TEMPLATE,
        difficulty=difficulty,
        num_distractors=num_distractors,
        lay_out=lay_out,
        distractor_spread_m=DISTRACTOR_SPREAD_M,
    )


def _zone_in_front(line: Placement, bounds: Placement) -> Zone:
    """Return the part of the area between line and mouth."""
    depth, width = bounds.size[:2]
    back, mouth = line.pose.x + line.size[1] / 2, AREA_X + depth / 2
    return Zone((back + mouth) / 2 + ZONE_SHIFT_M, 0.0, mouth - back, width)
