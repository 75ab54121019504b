"""Shared parts of the tasks that rotate objects in place."""

import math
from collections.abc import Sequence

from openvima.catalog import Pool
from openvima.catalog.objects import NO_SYMMETRY, object_spec
from openvima.errors import ConfigError
from openvima.scene import AtPose, Placement, Pose, Tolerance

ANGLES_DEG = (30, 60, 90, 120, 150)  # clockwise seen from above, i.e. negative yaw
TOLERANCE_DEG = 15


def rotated_clockwise(pose: Pose, angle_deg: float) -> Pose:
    """Rotate a pose in place, clockwise seen from above for positive angles."""
    return pose.rotated(-math.radians(angle_deg))


def rotation_goal(placement: Placement, angle_deg: float, *, position_m: float) -> AtPose:
    """Return the goal of a rotation in place, within 15 degrees.

    Args:
        placement: The object at its start.
        angle_deg: Positive is clockwise seen from above.
        position_m: Position tolerance in metres.
    """
    tolerance = Tolerance(position_m, yaw_rad=math.radians(TOLERANCE_DEG))
    return AtPose(
        placement.id, rotated_clockwise(placement.pose, angle_deg), tolerance, relative_to=placement.id
    )


def check_angles(angles_deg: object) -> None:
    """Check that all angles are numbers beyond the tolerance.

    Raises:
        ConfigError: An angle is within 15 degrees of 0, or this is not a list of numbers.
    """
    if not isinstance(angles_deg, Sequence) or isinstance(angles_deg, str):
        raise ConfigError(
            f"angles_deg is {angles_deg!r}; give a list of degrees, such as {list(ANGLES_DEG)}."
        )
    wrong = [str(angle) for angle in angles_deg if not _is_large(angle)]
    if wrong or not angles_deg:
        given = ", ".join(wrong) or "nothing"
        raise ConfigError(
            f"angles_deg holds {given}; each angle must be larger than {TOLERANCE_DEG} degrees."
        )


def _is_large(angle: object) -> bool:
    if not isinstance(angle, int | float) or not math.isfinite(angle):
        return False
    return abs(math.remainder(angle, 360)) > TOLERANCE_DEG


def check_asymmetric(pool: Pool) -> None:
    """Check that the objects of a pool have no rotational symmetry and at least two textures.

    Raises:
        ConfigError: An object has a rotational symmetry, or there are fewer than two textures.
    """
    symmetric = [name for name in pool.dragged_objects if object_spec(name).symmetry_rad != NO_SYMMETRY]
    if symmetric:
        raise ConfigError(
            f"{', '.join(symmetric)} have a rotational symmetry; give objects without one, such as letters."
        )
    if len(set(pool.dragged_textures)) < 2:
        raise ConfigError(
            f"the pool's dragged textures are {pool.dragged_textures}; distractors need a second one."
        )
