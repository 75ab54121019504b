"""Commands of the low-level control: one motion of the tool, ten a second."""

from dataclasses import dataclass

import numpy as np

from openvima.errors import ActionError, ConfigError, unknown_name

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
        except (TypeError, ValueError):  # such as a tensor on a device
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
