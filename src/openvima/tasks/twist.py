"""`twist`: infer the angle of "twist" from image pairs, then rotate all objects of one texture by it.

Scene:    one or more targets of one texture, distractors of other textures; no shape has symmetries.
Prompt:   '"Twist" is defined as rotating object a specific angle. For examples: From {before_twist_1} to
          {after_twist_1}. … Now twist all red swirl objects.' Each pair shows an object with the
          shape, but not the texture, of a target.
Success:  each yaw within 15 degrees of the target, position within 0.05 m of the start.
Source:   VIMA paper, task list of the appendix, "Twist".
"""

import math

from openvima.scene import DistractorsApart, Placement, Pose, Problem, Prompt, SceneImage
from openvima.tasks.options import Difficulty, SomeDistractors
from openvima.tasks.placing import (
    ANGLES_DEG,
    rotated_clockwise,
    rotation_goal,
)
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

NUM_EXAMPLES = 3
EXAMPLES = " ".join(f"From {{before_twist_{n}}} to {{after_twist_{n}}}." for n in range(1, NUM_EXAMPLES + 1))
REQUEST = "Now twist all {twist_obj_texture} objects."
TEMPLATE = f'"Twist" is defined as rotating object a specific angle. For examples: {EXAMPLES} {REQUEST}'
NUM_OBJECTS = {"easy": 3, "medium": 4, "hard": 5}
TOLERANCE_M = 0.05
EXAMPLE_LOW, EXAMPLE_HIGH = (0.4375, -0.375), (0.5625, 0.375)  # m, x and y, of objects in examples


@register_task(
    "twist",
    family="novel_concept_grounding",
    template=TEMPLATE,
    oracle_max_steps=NUM_OBJECTS["easy"] + 2,
)
def sample(
    table: TableSampler,
    *,
    num_distractors: SomeDistractors = None,
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Distractors, 0 … 6; by default the objects that are no targets.
        difficulty: "easy", "medium" or "hard": 3, 4 or 5 objects, at least one of them a target and at least
            one a distractor.
    """
    num_objects = NUM_OBJECTS[difficulty]
    objects, textures = table.pool.dragged_objects, table.pool.dragged_textures

    num_targets = int(table.rng.integers(1, num_objects))
    if num_distractors is None:
        num_distractors = num_objects - num_targets
    angle_deg, texture = table.choose(ANGLES_DEG), table.choose(textures)
    others = [other for other in textures if other != texture]
    targets = table.place(
        "object to rotate",
        lambda: (table.choose(objects), texture),
        count=num_targets,
        tries=num_targets + 10,
    )
    distractors = table.place(
        "distractor",
        table.drawing(objects, others),
        count=num_distractors,
        tries=num_distractors + 10,
    )
    examples: dict[str, SceneImage] = {}
    for n in range(1, NUM_EXAMPLES + 1):
        before = _example(table.blank(), table.choose(targets).object, table.choose(others))
        examples[f"before_twist_{n}"] = SceneImage.of([before])
        examples[f"after_twist_{n}"] = SceneImage.of([before.at(rotated_clockwise(before.pose, angle_deg))])
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, twist_obj_texture=texture, **examples),
        goals=tuple(rotation_goal(target, angle_deg, position_m=TOLERANCE_M) for target in targets),
        constraints=(DistractorsApart.of(distractors),),
        oracle_max_steps=num_objects + 2,
    )


def _example(table: TableSampler, object_name: str, texture: str) -> Placement:
    """Place an object near the middle of an empty table, at a random heading."""
    x, y = table.rng.uniform(EXAMPLE_LOW, EXAMPLE_HIGH).tolist()
    pose = Pose.planar(x, y, table.rng.uniform(0.0, 2 * math.pi))
    return table.add(object_name, texture, pose=pose, z=0.0)
