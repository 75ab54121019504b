"""What tasks share that ask for an object to be turned on the spot."""

import math
from collections.abc import Sequence

from openvima.catalog import Pool
from openvima.catalog.objects import NO_SYMMETRY, object_spec
from openvima.errors import ConfigError
from openvima.scene import AtPose, Placement, Pose, Tolerance

ANGLES_DEG = (30, 60, 90, 120, 150)  # clockwise seen from above, i.e. negative yaw
TOLERANCE_DEG = 15


def turned(pose: Pose, angle_deg: float) -> Pose:
    """Turn a pose on the spot, clockwise seen from above for positive angles."""
    return pose.rotated(-math.radians(angle_deg))


def turn_goal(placement: Placement, angle_deg: float, *, position_m: float) -> AtPose:
    """Ask for an object to be turned on the spot, within 15 degrees.

    Args:
        placement: The object at its start.
        angle_deg: Positive turns clockwise seen from above.
        position_m: How far in metres it may end up from its start.
    """
    tolerance = Tolerance(position_m, yaw_rad=math.radians(TOLERANCE_DEG))
    return AtPose(placement.id, turned(placement.pose, angle_deg), tolerance, relative_to=placement.id)


def check_angles(angles_deg: object) -> None:
    """Refuse angles that are no numbers, and those that are met, or nearly met, before anything is turned.

    Raises:
        ConfigError: An angle is within 15 degrees of no turn at all, or what was given is no list of numbers.
    """
    if not isinstance(angles_deg, Sequence) or isinstance(angles_deg, str):
        raise ConfigError(
            f"angles_deg is {angles_deg!r}; give a list of degrees, such as {list(ANGLES_DEG)}."
        )
    wrong = [str(angle) for angle in angles_deg if not _is_large(angle)]
    if wrong or not angles_deg:
        shown = ", ".join(wrong) or "nothing"
        raise ConfigError(
            f"angles_deg holds {shown}; each angle must turn by more than {TOLERANCE_DEG} degrees."
        )


def _is_large(angle: object) -> bool:
    if not isinstance(angle, int | float) or not math.isfinite(angle):
        return False
    return abs(math.remainder(angle, 360)) > TOLERANCE_DEG


def check_turnable(pool: Pool) -> None:
    """Refuse a pool whose objects do not show how they were turned, or cannot be told apart by texture.

    Raises:
        ConfigError: An object has a rotational symmetry, or there are fewer than two textures.
    """
    symmetric = [name for name in pool.dragged_objects if object_spec(name).symmetry_rad != NO_SYMMETRY]
    if symmetric:
        raise ConfigError(
            f"{', '.join(symmetric)} may look the same after a turn; draw from objects without rotational "
            f"symmetry, such as letters."
        )
    if len(set(pool.dragged_textures)) < 2:
        raise ConfigError(
            f"the pool's dragged textures are {pool.dragged_textures}; distractors need a second one."
        )
