"""Actions: the two poses of one primitive, and the commands of the low-level control, ten a second."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from openvima.errors import ActionError, ConfigError, echo, unknown_name
from openvima.scene.scene import (
    IDENTITY,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    Point,
    Pose,
    Quaternion,
    normalised,
    yaw_quaternion,
)

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

    pose0_position: Point
    pose1_position: Point
    pose0_rotation: Quaternion = IDENTITY
    pose1_rotation: Quaternion = IDENTITY

    @staticmethod
    def planar(pick: Point, place: Point, yaw_rad: float = 0.0) -> "Action":
        """Build an action from two points and a relative rotation, counter-clockwise from above.

        Positions are clipped to the workspace and rounded to float32.
        """
        (x0, y0), (x1, y1) = (
            np.clip(np.array(point, np.float32), *_LIMITS[2]).tolist() for point in (pick, place)
        )
        x, y, z, w = np.array(yaw_quaternion(yaw_rad), np.float32).tolist()
        return Action((x0, y0), (x1, y1), pose1_rotation=(x, y, z, w))

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
        missing = ", ".join(key for key in ACTION_SHAPES if key not in action)
        unknown = ", ".join(str(key) for key in action if key not in ACTION_SHAPES)
        problems = [f"{missing} missing."] if missing else []
        if unknown:
            problems.append(f"unknown keys {echo(unknown)}; allowed are {', '.join(ACTION_SHAPES)}.")
        values: dict[str, Any] = {}
        for key, length in ACTION_SHAPES.items():
            if key in action:
                try:
                    values[key] = _within_limits(_as_float32(action[key], length))
                except ActionError as error:
                    problems.append(f"{key} is {error}.")
        if problems:
            raise ActionError(" ".join(problems) + " Nothing was moved.")
        return Action(**values)

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


def pose_after(pose: Pose, action: Action) -> Pose:
    """Return where a pick-and-place action would put an object, at the height that it has.

    Args:
        pose: Pose of the object.
        action: The action, which picks it.
    """
    turn_rad = math.remainder(action.yaw1_rad - action.yaw0_rad, 2 * math.pi)
    picked_from_object = Pose.planar(*action.pose0_position).inverse() @ pose
    return Pose.planar(*action.pose1_position, turn_rad) @ picked_from_object


def _tool_yaw(quaternion: Quaternion) -> float:
    """Heading of the tool's x axis; tilt is ignored."""
    if not any(quaternion):
        return 0.0
    x, y, z, w = normalised(quaternion)
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def _as_float32(value: object, length: int) -> np.ndarray:
    """Return numbers in float32 precision.

    Raises:
        ActionError: The shape or dtype is another, or a number is not finite.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        # Such as nested lists of unequal lengths, or a tensor on a device or with gradients.
        array = np.empty(0, object)
    if array.shape != (length,) or not np.issubdtype(array.dtype, np.floating):
        raise ActionError(
            f"a {type(value).__name__} of shape {array.shape} and dtype {array.dtype}; it must be {length} "
            "floating-point numbers"
        )
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    if not np.isfinite(array).all():
        raise ActionError(f"({', '.join(f'{v:g}' for v in array)}); all values must be finite")
    return array


def _within_limits(array: np.ndarray) -> tuple[float, ...]:
    """Return a position or a quaternion, whose values are within bounds.

    Raises:
        ActionError: One is not.
    """
    values = tuple(array.tolist())
    low, high = _LIMITS[len(values)]
    if all(least <= value <= most for least, value, most in zip(low, values, high, strict=True)):
        return values
    allowed = (
        f"x must lie in {low[0]:g} … {high[0]:g} m and y in {low[1]:g} … {high[1]:g} m"
        if len(values) == 2
        else "each component must lie in -1 … 1"
    )
    raise ActionError(f"({', '.join(f'{v:.4g}' for v in values)}); {allowed}")


CONTROLS = ("primitives", "end_effector")
PRIMITIVES, END_EFFECTOR = CONTROLS
CONTROL_HZ = 10
COMMAND_NAMES = ("dx", "dy", "dz", "dyaw", "tool")
MAX_MOVE_M = 0.05  # of the tool in one step along each axis: 0.5 m/s
HIGHEST_TIP_Z_M = 0.35  # of the tool
MAX_TURN_RAD = 0.2  # of the tool in one step: 2 rad/s
COMMAND_HIGH = (MAX_MOVE_M, MAX_MOVE_M, MAX_MOVE_M, MAX_TURN_RAD, 1.0)
COMMAND_LOW = (-MAX_MOVE_M, -MAX_MOVE_M, -MAX_MOVE_M, -MAX_TURN_RAD, 0.0)
SECONDS_PER_PRIMITIVE = 10  # time limit of an episode, for each step that it has with primitives
STEPS_PER_PRIMITIVE = CONTROL_HZ * SECONDS_PER_PRIMITIVE


def check_control(control: str) -> None:
    """Check the name of a control.

    Raises:
        ConfigError: There is no such control.
    """
    if control not in CONTROLS:
        raise ConfigError(unknown_name("control", control, CONTROLS))


def steps_per_primitive(control: str) -> int:
    """Steps that a control has for each step with primitives."""
    return STEPS_PER_PRIMITIVE if control == END_EFFECTOR else 1


@dataclass(frozen=True, slots=True)
class ToolPose:
    """Pose of the vertical tool: its tip in metres, and its heading in radians, not wrapped."""

    x: float
    y: float
    z: float
    yaw_rad: float


@dataclass(frozen=True, slots=True)
class ToolCommand:
    """What the tool does in one step of 0.1 s.

    Args:
        dx: Metres away from the robot's base.
        dy: Metres to its left.
        dz: Metres up.
        dyaw: Radians, counter-clockwise from above.
        tool: Suction on, or the spatula pressed to the table.
    """

    dx: float
    dy: float
    dz: float
    dyaw: float
    tool: bool

    @staticmethod
    def from_array(command: object) -> "ToolCommand":
        """Validate and convert a command of a policy.

        Args:
            command: Five numbers in the order of `COMMAND_NAMES`, any floating-point dtype. The tool is on
                above 0.5. A motion faster than `COMMAND_HIGH` keeps its direction and loses speed.

        Returns:
            The command, in float32 precision.

        Raises:
            ActionError: It has another shape or dtype, or a value that is not finite.
        """
        try:
            array = _as_float32(command, len(COMMAND_NAMES))
        except ActionError as error:
            raise ActionError(
                f"the command is {error}: {', '.join(COMMAND_NAMES)}, with control 'end_effector'. Nothing "
                "was moved."
            ) from None
        motion = array[:-1].astype(np.float64)
        excess = float((np.abs(motion) / np.array(COMMAND_HIGH[:-1], np.float32)).max())
        dx, dy, dz, dyaw = (motion / max(excess, 1.0)).tolist()
        return ToolCommand(dx, dy, dz, dyaw, bool(array[-1] > 0.5))

    def to_array(self) -> np.ndarray:
        """Return the five numbers, float32."""
        return np.array([self.dx, self.dy, self.dz, self.dyaw, self.tool], dtype=np.float32)


STAY = ToolCommand(0.0, 0.0, 0.0, 0.0, False)
