"""`same_texture`: put every object that has the base's texture into the base.

Scene:    a base, two objects of any shape in its texture, and a distractor in another one.
Prompt:   "Put all objects with the same texture as {base_obj} into it."
Success:  those objects within 0.125 m of the base's origin (0.0875 m if it is a bowl), in any order, while no
          distractor is as near to it or to one of them.
Source:   VIMA paper, task list of the appendix, "Visual reasoning".
"""

from openvima.scene import Problem
from openvima.tasks.options import Difficulty, SomeDistractors
from openvima.tasks.placing import gathering_problem
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

TEMPLATE = "Put all objects with the same texture as {base_obj} into it."


@register_task("same_texture", family="visual_reasoning", template=TEMPLATE, oracle_max_steps=4)
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
    return gathering_problem(
        table,
        TEMPLATE,
        lambda base: (pool.dragged_objects, (base.texture,), pool.dragged_objects),
        difficulty=difficulty,
        num_distractors=num_distractors,
        after_bowl=after_bowl,
    )
