"""`reverse_order`: reverse the order of the objects of a row.

Scene:    six objects in a row along the table, and a distractor beside it.
Prompt:   "Reverse the order of {object_1} {object_2} {object_3} {object_4} {object_5} {object_6}." The images
          come from left to right.
Success:  each object was within 0.07 m of the place of its counterpart, and at the end the distractor is as
          near to no object or place of the row. Two objects that swap their places need a third place.
Source:   level L8 of openvima; not in the VIMA paper.
"""

from openvima.scene import AtPose, DistractorsApart, ObjectImage, Pose, Problem, Prompt, Tolerance
from openvima.tasks.options import FewDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

NUM_OBJECTS = 6
TEMPLATE = f"Reverse the order of {' '.join(f'{{object_{n}}}' for n in range(1, NUM_OBJECTS + 1))}."
TOLERANCE = Tolerance(position_m=0.07)  # below half the distance of two places
ROW_X, ASIDE_M = 0.5, 0.17
SPACING_M = 0.16
_SPARE_STEPS = 2


@register_task("reverse_order", family="visual_reasoning", template=TEMPLATE, oracle_max_steps=11)
def sample(table: TableSampler, *, num_distractors: FewDistractors = 1) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Further objects, 0 … 3.
    """
    appearances = table.distinct(table.appearances(), NUM_OBJECTS + num_distractors)
    places = [Pose.planar(ROW_X, (n - (NUM_OBJECTS - 1) / 2) * SPACING_M) for n in range(NUM_OBJECTS)]
    side = table.choose((-1, 1))  # of the row where the oracle puts objects aside
    row = [
        table.add(name, texture, pose=pose)
        for (name, texture), pose in zip(appearances, places, strict=False)
    ]
    beside = table.shuffled(range(NUM_OBJECTS))[:num_distractors]
    distractors = [
        table.add(name, texture, pose=places[n].moved(dx=-side * ASIDE_M))
        for (name, texture), n in zip(appearances[NUM_OBJECTS:], beside, strict=True)
    ]

    half = NUM_OBJECTS // 2
    first, second = list(range(half)), list(range(half, NUM_OBJECTS))
    if table.choose((False, True)):
        first, second = second, first
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, **{f"object_{n}": ObjectImage(p) for n, p in enumerate(row, 1)}),
        goals=tuple(AtPose(row[n].id, places[NUM_OBJECTS - 1 - n], TOLERANCE) for n in (*second, *first)),
        constraints=(DistractorsApart.of(distractors, at_end=True),),
        prerequisites=tuple(AtPose(row[n].id, places[n].moved(dx=side * ASIDE_M), TOLERANCE) for n in first),
        oracle_max_steps=3 * half + _SPARE_STEPS,
    )
