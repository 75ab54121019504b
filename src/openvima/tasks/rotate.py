"""`rotate`: turn an object on the spot by an angle given in degrees.

Scene:    one object without rotational symmetry and distractors of another texture, all free on the table.
Prompt:   "Rotate the {dragged_obj} 60 degrees."
Success:  yaw within 15 degrees of the asked one, position within 0.1 m of the start.
Source:   VIMA paper, task list of the appendix, "Rotate".
"""

import math
from collections.abc import Sequence

from openvima.errors import ConfigError
from openvima.scene import AtPose, DistractorsApart, ObjectImage, Problem, Prompt, Tolerance
from openvima.tasks.options import check_count, check_difficulty
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

TEMPLATE = "Rotate the {dragged_obj} {angle_in_degree} degrees."
ANGLES_DEG = (30, 60, 90, 120, 150)  # clockwise seen from above, i.e. negative yaw
TOLERANCE_DEG = 15
TOLERANCE = Tolerance(position_m=0.1, yaw_rad=math.radians(TOLERANCE_DEG))
NUM_DISTRACTORS = {"easy": 1, "medium": 3, "hard": 5}


@register_task("rotate", family="simple_manipulation", template=TEMPLATE, oracle_max_steps=3)
def sample(
    table: TableSampler,
    *,
    angles_deg: Sequence[float] = ANGLES_DEG,
    num_distractors: int | None = None,
    difficulty: str = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: The table to lay.
        angles_deg: Angles to choose from; positive turns clockwise seen from above.
        num_distractors: Further objects, 0 … 6; by default as many as the difficulty says.
        difficulty: "easy", "medium" or "hard": 1, 3 or 5 distractors.
    """
    check_difficulty(difficulty)
    num_distractors = NUM_DISTRACTORS[difficulty] if num_distractors is None else num_distractors
    check_count("num_distractors", num_distractors, high=6)
    _check_angles(angles_deg)
    objects, textures = table.pool.dragged_objects, table.pool.dragged_textures

    angle_deg = table.choose(angles_deg)
    target = table.place_one("target", lambda: (table.choose(objects), table.choose(textures)))
    others = [texture for texture in textures if texture != target.texture]
    distractors = table.place(
        "distractor",
        lambda: (table.choose(objects), table.choose(others)),
        count=num_distractors,
        tries=num_distractors + 10,
        apart_m=TOLERANCE.position_m,
    )
    turned = target.pose.rotated(-math.radians(angle_deg))
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, dragged_obj=ObjectImage(target), angle_in_degree=round(angle_deg)),
        goals=(AtPose(target.id, turned, TOLERANCE, relative_to=target.id),),
        constraints=(DistractorsApart(tuple(d.id for d in distractors)),),
    )


def _check_angles(angles_deg: Sequence[float]) -> None:
    small = [angle for angle in angles_deg if abs(math.remainder(angle, 360)) <= TOLERANCE_DEG]
    if small or not angles_deg:
        shown = ", ".join(f"{angle:g}" for angle in small) or "nothing"
        raise ConfigError(
            f"angles_deg holds {shown}; each angle must turn by more than {TOLERANCE_DEG} degrees."
        )
