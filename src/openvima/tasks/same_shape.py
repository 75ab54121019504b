"""`same_shape`: put every object that has the base's outline into the base.

Scene:    a base, two objects with its profile (circle or square), and a distractor with another one; letters,
          flowers and the like have neither.
Prompt:   "Put all objects with the same profile as {base_obj} into it."
Success:  those objects within 0.125 m of the base's origin (0.0875 m if it is a bowl), in any order, while no
          distractor is as near to it or to one of them.
Source:   VIMA paper, task list of the appendix, "Visual reasoning".
"""

from openvima.catalog import object_spec
from openvima.scene import Placement, Problem
from openvima.tasks.options import Difficulty, SomeDistractors
from openvima.tasks.placing import gathering_problem
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

TEMPLATE = "Put all objects with the same profile as {base_obj} into it."


@register_task("same_shape", family="visual_reasoning", template=TEMPLATE, oracle_max_steps=4)
def sample(
    table: TableSampler,
    *,
    num_distractors: SomeDistractors = None,
    after_bowl: bool | None = None,
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Distractors, 0 … 6; by default that of the difficulty.
        after_bowl: Whether the bowl's tolerance applies to every base; see `gathering_problem`.
        difficulty: "easy", "medium" or "hard": 2 objects and 1 distractor, 2 and 2, or 3 and 3.
    """
    pool = table.pool

    def choices_for(base: Placement) -> tuple[list[str], tuple[str, ...], list[str]]:
        profile = object_spec(base.object).profile
        alike = [name for name in pool.dragged_objects if object_spec(name).profile == profile]
        different = [name for name in pool.dragged_objects if object_spec(name).profile != profile]
        return alike, pool.dragged_textures, different

    return gathering_problem(
        table,
        TEMPLATE,
        choices_for,
        difficulty=difficulty,
        num_distractors=num_distractors,
        after_bowl=after_bowl,
    )
