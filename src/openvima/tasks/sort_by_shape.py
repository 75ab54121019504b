"""`sort_by_shape`: put all objects of each of three shapes into a container of its own.

Scene:    three containers, six to eight objects of three shapes in any texture, a distractor of a fourth one.
Prompt:   "Put each {shape_1} into {base_1}, each {shape_2} into {base_2} and each {shape_3} into {base_3}."
          Images of shapes are gray.
Success:  every object within 0.125 m of the origin of its container, in any order, while no object is as near
          to another one's container, or to an object of another shape.
Source:   level L8 of openvima; not in the VIMA paper.
"""

from openvima.scene import Problem
from openvima.tasks.novel_words import gray_image
from openvima.tasks.options import FewDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.sorting import NUM_GROUPS, sorting_problem
from openvima.tasks.table import TableSampler

TEMPLATE = "Put each {shape_1} into {base_1}, each {shape_2} into {base_2} and each {shape_3} into {base_3}."


@register_task("sort_by_shape", family="visual_reasoning", template=TEMPLATE, oracle_max_steps=11)
def sample(table: TableSampler, *, num_distractors: FewDistractors = 1) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Objects of other shapes, 0 … 3.
    """
    pool = table.pool
    drawn = table.shuffled(pool.dragged_objects)
    shapes, others = drawn[:NUM_GROUPS], drawn[NUM_GROUPS:]
    return sorting_problem(
        table,
        TEMPLATE,
        draw=lambda group: (shapes[group], table.choose(pool.dragged_textures)),
        draw_distractor=table.drawing(others, pool.dragged_textures),
        base_textures=pool.base_textures,
        describe=lambda number, group: {f"shape_{number + 1}": gray_image(group[0])},
        num_distractors=num_distractors,
    )
