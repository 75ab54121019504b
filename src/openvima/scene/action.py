"""Actions: the two poses of one primitive, and the commands of the low-level control, ten a second."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from openvima.errors import ActionError, ConfigError, echo, unknown_name
from openvima.scene.scene import (
    IDENTITY,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
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
                values[key], problem = _check_value(key, action[key], length)
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


def pose_after(pose: Pose, action: Action) -> Pose:
    """Return where a pick-and-place action would put an object, at the height that it has.

    Args:
        pose: Pose of the object.
        action: The action, which picks it.
    """
    turn_rad = math.remainder(action.yaw1_rad - action.yaw0_rad, 2 * math.pi)
    picked_from_object = Pose.planar(*action.pose0_position).inverse() @ pose
    return Pose.planar(*action.pose1_position, turn_rad) @ picked_from_object


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


def _check_value(key: str, value: object, length: int) -> tuple[tuple[float, ...], list[str]]:
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):
        # Such as nested lists of unequal lengths, or a tensor on a device or with gradients.
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
        names = ", ".join(COMMAND_NAMES)
        try:
            array = np.asarray(command)
        except (TypeError, ValueError, RuntimeError):  # such as a tensor on a device, or with gradients
            array = np.empty(0, object)
        if not np.issubdtype(array.dtype, np.floating) or array.shape != (len(COMMAND_NAMES),):
            given = f"shape {array.shape}, dtype {array.dtype}"
            if not isinstance(command, np.ndarray):
                given = f"a {type(command).__name__}" + (f" ({given})" if array.dtype != object else "")
            raise ActionError(
                f"the command is {given}; with control 'end_effector' it must be {len(COMMAND_NAMES)} "
                f"floating-point numbers: {names}. Nothing was moved."
            )
        with np.errstate(over="ignore"):  # reported below as not finite
            array = array.astype(np.float32)
        if not np.isfinite(array).all():
            text = ", ".join(f"{value:g}" for value in array)
            raise ActionError(f"the command is ({text}); all values must be finite. Nothing was moved.")
        motion = array[:-1].astype(np.float64)
        excess = float((np.abs(motion) / np.array(COMMAND_HIGH[:-1], np.float32)).max())
        dx, dy, dz, dyaw = (motion / max(excess, 1.0)).tolist()
        return ToolCommand(dx, dy, dz, dyaw, bool(array[-1] > 0.5))

    def to_array(self) -> np.ndarray:
        """Return the five numbers, float32."""
        return np.array([self.dx, self.dy, self.dz, self.dyaw, self.tool], dtype=np.float32)


STAY = ToolCommand(0.0, 0.0, 0.0, 0.0, False)
