"""`same_shape`: put every object that has the base's outline into the base.

Scene:    a base, two objects with its profile (circle or square), and a distractor with another one; letters,
          flowers and the like have neither.
Prompt:   "Put all objects with the same profile as {base_obj} into it."
Success:  those objects within 0.125 m of the base's origin (0.0875 m if it is a bowl), in any order, while no
          distractor is as near to it or to one of them.
Source:   VIMA paper, task list of the appendix, "Visual reasoning".
"""

from openvima.catalog import Pool, object_spec
from openvima.scene import Problem
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
    by_base = {name: _by_profile(pool, name) for name in pool.base_objects}
    texture = table.choose(pool.base_textures)
    base = table.place_one("base", lambda: (table.choose(pool.base_objects), texture))
    alike, different = by_base[base.object]
    return gathering_problem(
        table,
        TEMPLATE,
        base=base,
        dragged_appearances=(alike, pool.dragged_textures),
        distractor_objects=different,
        difficulty=difficulty,
        num_distractors=num_distractors,
        after_bowl=after_bowl,
    )


def _by_profile(pool: Pool, base_object: str) -> tuple[list[str], list[str]]:
    """Split the dragged objects by whether they have the profile of a base."""
    profile = object_spec(base_object).profile
    alike = [name for name in pool.dragged_objects if object_spec(name).profile == profile]
    different = [name for name in pool.dragged_objects if object_spec(name).profile != profile]
    return alike, different
