"""`sort_by_texture`: put all objects of each of three textures into a container of its own.

Scene:    three containers, six to eight objects of any shape in three textures, a distractor in a fourth one.
Prompt:   "Put all {texture_1} objects into {base_1}, all {texture_2} objects into {base_2} and all
          {texture_3} objects into {base_3}." No container has one of these textures.
Success:  every object within 0.125 m of the origin of its container, in any order, while no object is as near
          to another one's container, or to an object of another texture.
Source:   level L8 of openvima; not in the VIMA paper.
"""

from openvima.scene import Problem
from openvima.tasks.options import FewDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.sorting import NUM_GROUPS, sorting_problem
from openvima.tasks.table import TableSampler

TEMPLATE = (
    "Put all {texture_1} objects into {base_1}, all {texture_2} objects into {base_2} and all {texture_3} "
    "objects into {base_3}."
)


@register_task("sort_by_texture", family="visual_reasoning", template=TEMPLATE, oracle_max_steps=11)
def sample(table: TableSampler, *, num_distractors: FewDistractors = 1) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Objects of other textures, 0 … 3.
    """
    pool = table.pool
    drawn = table.shuffled(pool.dragged_textures)
    textures, others = drawn[:NUM_GROUPS], drawn[NUM_GROUPS:]
    return sorting_problem(
        table,
        TEMPLATE,
        draw=lambda group: (table.choose(pool.dragged_objects), textures[group]),
        draw_distractor=table.drawing(pool.dragged_objects, others),
        base_textures=others,
        describe=lambda number, _: {f"texture_{number + 1}": textures[number]},
        num_distractors=num_distractors,
    )
