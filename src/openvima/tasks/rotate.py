"""`rotate`: rotate an object in place by an angle in degrees.

Scene:    one object without rotational symmetry and distractors of another texture, all free on the table.
Prompt:   "Rotate the {dragged_obj} 60 degrees."
Success:  yaw within 15 degrees of the asked one, position within 0.1 m of the start.
Source:   VIMA paper, task list of the appendix, "Rotate".
"""

from collections.abc import Sequence

from openvima.scene import DistractorsApart, ObjectImage, Problem, Prompt
from openvima.tasks.options import Difficulty, SomeDistractors
from openvima.tasks.placing import ANGLES_DEG, TOLERANCE, check_angles, place_distractors, rotation_goal
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

TEMPLATE = "Rotate the {dragged_obj} {angle_in_degree} degrees."
NUM_DISTRACTORS = {"easy": 1, "medium": 3, "hard": 5}


@register_task(
    "rotate",
    family="simple_object_manipulation",
    template=TEMPLATE,
    oracle_max_steps=3,
    distractors_allowed=True,
)
def sample(
    table: TableSampler,
    *,
    angles_deg: Sequence[float] = ANGLES_DEG,
    num_distractors: SomeDistractors = None,
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        angles_deg: Angles to choose from; positive turns clockwise seen from above.
        num_distractors: Further objects, 0 … 6; by default as many as the difficulty says.
        difficulty: "easy", "medium" or "hard": 1, 3 or 5 distractors.
    """
    num_distractors = NUM_DISTRACTORS[difficulty] if num_distractors is None else num_distractors
    check_angles(angles_deg)
    objects, textures = table.pool.dragged_objects, table.pool.dragged_textures

    angle_deg = table.choose(angles_deg)
    target = table.place_one("target", table.drawing(objects, textures))
    others = [texture for texture in textures if texture != target.texture]
    distractors = place_distractors(table, table.drawing(objects, others), count=num_distractors)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, dragged_obj=ObjectImage(target), angle_in_degree=round(angle_deg)),
        goals=(rotation_goal(target, angle_deg, position_m=TOLERANCE.position_m),),
        constraints=(DistractorsApart.of(distractors),),
    )
