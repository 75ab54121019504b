"""Actions: the two poses of one primitive."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from openvima.errors import ActionError, echo
from openvima.scene.pose import IDENTITY, Quaternion, normalised, yaw_quaternion
from openvima.scene.scene import WORKSPACE_HIGH, WORKSPACE_LOW

ACTION_SHAPES = {
    "pose0_position": 2,
    "pose0_rotation": 4,
    "pose1_position": 2,
    "pose1_rotation": 4,
}
# Lowest and highest values of a position and a quaternion, in float32 precision.
_LIMITS = {
    2: tuple(np.array(limit, np.float32).tolist() for limit in (WORKSPACE_LOW, WORKSPACE_HIGH)),
    4: ((-1.0,) * 4, (1.0,) * 4),
}


@dataclass(frozen=True, slots=True)
class Action:
    """One step of the robot: pick at pose0 and place at pose1, or sweep from pose0 to pose1.

    Args:
        pose0_position: x, y in metres.
        pose1_position: x, y in metres.
        pose0_rotation: Quaternion xyzw; only its yaw matters.
        pose1_rotation: Quaternion xyzw; only its yaw matters. The spatula ignores both rotations.
    """

    pose0_position: tuple[float, float]
    pose1_position: tuple[float, float]
    pose0_rotation: Quaternion = IDENTITY
    pose1_rotation: Quaternion = IDENTITY

    @staticmethod
    def planar(pick: tuple[float, float], place: tuple[float, float], yaw_rad: float = 0.0) -> "Action":
        """Build an action from two points and a relative rotation, counter-clockwise from above.

        Positions are clipped to the workspace and rounded to float32.
        """
        low, high = _LIMITS[2]
        pose0 = np.clip(np.array(pick, dtype=np.float32), low, high)
        pose1 = np.clip(np.array(place, dtype=np.float32), low, high)
        x, y, z, w = (float(np.float32(c)) for c in yaw_quaternion(yaw_rad))
        return Action(
            (float(pose0[0]), float(pose0[1])),
            (float(pose1[0]), float(pose1[1])),
            IDENTITY,
            (x, y, z, w),
        )

    @staticmethod
    def from_arrays(action: Mapping[str, object]) -> "Action":
        """Validate and convert an action of a policy.

        Args:
            action: `pose0_position` and `pose1_position`, shape (2,), metres; `pose0_rotation` and
                `pose1_rotation`, shape (4,), quaternion xyzw. Any floating-point dtype.

        Returns:
            The action, in float32 precision.

        Raises:
            ActionError: A key is missing or unknown, or an array has a wrong shape or dtype, a value that is
                not finite or out of bounds. All problems are in one message.
        """
        if not isinstance(action, Mapping):
            keys, given = ", ".join(ACTION_SHAPES), type(action).__name__
            raise ActionError(f"an action is a mapping with keys {keys}, not {given}. Nothing was moved.")
        problems = _key_problems(action)
        values: dict[str, tuple[float, ...]] = {}
        for key, length in ACTION_SHAPES.items():
            if key in action:
                values[key], problem = _checked(key, action[key], length)
                problems += problem
        if problems:
            raise ActionError(" ".join(problems) + " Nothing was moved.")
        x0, y0 = values["pose0_position"]
        x1, y1 = values["pose1_position"]
        ax, ay, az, aw = values["pose0_rotation"]
        bx, by, bz, bw = values["pose1_rotation"]
        return Action((x0, y0), (x1, y1), (ax, ay, az, aw), (bx, by, bz, bw))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the action as float32 arrays under the four keys."""
        return {key: np.array(getattr(self, key), dtype=np.float32) for key in ACTION_SHAPES}

    @property
    def yaw0_rad(self) -> float:
        """Tool heading at pose0, in radians; a zero quaternion counts as no rotation."""
        return _tool_yaw(self.pose0_rotation)

    @property
    def yaw1_rad(self) -> float:
        """Tool heading at pose1, in radians; a zero quaternion counts as no rotation."""
        return _tool_yaw(self.pose1_rotation)


def is_valid_batch(actions: Mapping[str, object], count: int) -> bool:
    """Return whether `Action.from_arrays` takes every row of a batch; faster than asking row by row.

    Args:
        actions: Arrays with `count` rows under the four keys.
        count: Number of actions.
    """
    if actions.keys() != ACTION_SHAPES.keys():
        return False
    for key, length in ACTION_SHAPES.items():
        value, (low, high) = actions[key], _LIMITS[length]
        if not isinstance(value, np.ndarray) or value.shape != (count, length) or value.dtype.kind != "f":
            return False
        with np.errstate(over="ignore"):
            rounded = value.astype(np.float32)
        if not ((low <= rounded) & (rounded <= high)).all():  # nor is what is not finite
            return False
    return True


def _tool_yaw(quaternion: Quaternion) -> float:
    """Heading of the tool's x axis; tilt is ignored."""
    if not any(quaternion):
        return 0.0
    x, y, z, w = normalised(quaternion)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _key_problems(action: Mapping[str, object]) -> list[str]:
    missing = [key for key in ACTION_SHAPES if key not in action]
    unknown = [str(key) for key in action if key not in ACTION_SHAPES]
    problems = [f"{', '.join(missing)} missing."] if missing else []
    if unknown:
        problems.append(f"unknown keys {echo(', '.join(unknown))}; allowed are {', '.join(ACTION_SHAPES)}.")
    return problems


def _checked(key: str, value: object, length: int) -> tuple[tuple[float, ...], list[str]]:
    try:
        array = np.asarray(value)
    except (TypeError, ValueError):  # such as nested lists of unequal lengths, or a tensor on a device
        return (), [f"{key} is a {type(value).__name__} that NumPy cannot convert; give {length} numbers."]
    if not np.issubdtype(array.dtype, np.floating):
        return (), [f"{key} has dtype {array.dtype}; it must be floating-point (float32)."]
    if array.shape != (length,):
        return (), [f"{key} has shape {array.shape}; it must be ({length},)."]
    with np.errstate(over="ignore"):  # reported below as not finite
        given = tuple(array.astype(np.float32).tolist())
    low, high = _LIMITS[length]
    if all(least <= value <= most for least, value, most in zip(low, given, high, strict=True)):
        return given, []
    if not all(map(math.isfinite, given)):
        return (), [f"{key} is {given}; all values must be finite."]
    text = ", ".join(f"{v:.4g}" for v in given)
    allowed = (
        f"x must lie in {low[0]:g} … {high[0]:g} m and y in {low[1]:g} … {high[1]:g} m"
        if length == 2
        else "each component must lie in -1 … 1"
    )
    return (), [f"{key} is ({text}); {allowed}."]
