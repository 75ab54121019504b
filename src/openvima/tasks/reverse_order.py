"""`reverse_order`: reverse the order of the objects of a row.

Scene:    six objects in a row along the table, and a distractor beside it.
Prompt:   "Reverse the order of {object_1} {object_2} {object_3} {object_4} {object_5} {object_6}." The images
          come from left to right.
Success:  each object was within 0.07 m of the place of its counterpart, and at the end the distractor is as
          near to no object or place of the row. Two objects that swap their places need a third place.
Source:   level L8 of openvima; not in the VIMA paper.
"""

from openvima.scene import AtPose, DistractorsApart, ObjectImage, Pose, Problem, Prompt, Tolerance
from openvima.tasks.options import check_count
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

NUM_OBJECTS = 6
TOLERANCE = Tolerance(position_m=0.07)  # below half the distance of two places
ROW_X, ASIDE_M = 0.5, 0.17
SPACING_M = 0.16
_SPARE_STEPS = 2


def template(num_objects: int) -> str:
    """Return the prompt with slots for that many objects."""
    return f"Reverse the order of {' '.join(f'{{object_{n + 1}}}' for n in range(num_objects))}."


@register_task(
    "reverse_order", family="visual_reasoning", template=template(NUM_OBJECTS), oracle_max_steps=11
)
def sample(table: TableSampler, *, num_objects: int = NUM_OBJECTS, num_distractors: int = 1) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_objects: Objects of the row, 4 … 6: six to nine moves.
        num_distractors: Further objects, 0 … 3.
    """
    check_count("num_objects", num_objects, low=4, high=NUM_OBJECTS)
    check_count("num_distractors", num_distractors, high=3)
    pool = table.pool
    options = [(name, texture) for name in pool.dragged_objects for texture in pool.dragged_textures]
    drawn = table.rng.choice(len(options), num_objects + num_distractors, replace=False)
    appearances = [options[index] for index in drawn]
    places = [Pose.planar(ROW_X, (n - (num_objects - 1) / 2) * SPACING_M) for n in range(num_objects)]
    side = table.choose((-1, 1))  # of the row where the oracle puts objects aside
    row = [
        table.add(name, texture, size=table.sample_size(name), pose=pose)
        for (name, texture), pose in zip(appearances, places, strict=False)
    ]
    beside = table.rng.permutation(num_objects)[:num_distractors].tolist()
    distractors = [
        table.add(name, texture, size=table.sample_size(name), pose=places[n].moved(dx=-side * ASIDE_M))
        for (name, texture), n in zip(appearances[num_objects:], beside, strict=True)
    ]

    half = num_objects // 2
    first, second = list(range(half)), list(range(num_objects - half, num_objects))
    if table.choose((False, True)):
        first, second = second, first
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(
            template(num_objects), **{f"object_{n}": ObjectImage(p) for n, p in enumerate(row, 1)}
        ),
        goals=tuple(AtPose(row[n].id, places[num_objects - 1 - n], TOLERANCE) for n in (*second, *first)),
        constraints=(DistractorsApart(tuple(p.id for p in distractors), at_end=True),),
        prerequisites=tuple(AtPose(row[n].id, places[n].moved(dx=side * ASIDE_M), TOLERANCE) for n in first),
        oracle_max_steps=3 * half + _SPARE_STEPS,
    )
