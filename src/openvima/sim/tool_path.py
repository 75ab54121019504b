"""Primitives as sequences of commands: how the oracle acts under low-level control."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

from openvima.scene import Action, EndEffector
from openvima.scene.command import MAX_MOVE_M, MAX_TURN_RAD, STAY, ToolCommand, ToolPose
from openvima.sim import end_effectors as tools
from openvima.sim.primitives import sweep_plan
from openvima.sim.tool_world import ToolWorld

_REACHED = 1e-6  # m and rad
_DOWN_M = -1.0  # below the table: until contact


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A pose to go to in a straight line, or as far as the arm and contacts let it.

    Args:
        pose: The pose of the tool.
        tool: Whether the tool is on meanwhile.
        take_hold: Go on until the tool has taken hold.
    """

    pose: ToolPose
    tool: bool
    take_hold: bool = False


def tool_path(action: Action, end_effector: EndEffector, *, compat: bool = False) -> Iterator[Waypoint]:
    """Yield the waypoints of a primitive.

    Args:
        action: The primitive.
        end_effector: The tool.
        compat: As in `sweep_plan`.
    """
    if end_effector == "suction":
        yield from _pick_and_place(action)
        return
    plan = sweep_plan(action, compat=compat)
    if plan is None:
        return
    yaw_rad = math.remainder(plan.yaw_rad, math.pi)  # both faces of the spatula are alike
    hover, low = tools.SWEEP_HOVER_TIP_Z_M, tools.SWEEP_TIP_Z_M
    yield Waypoint(ToolPose(*plan.start, hover, yaw_rad), tool=False)
    yield Waypoint(ToolPose(*plan.start, low, yaw_rad), tool=False)
    for x, y in (plan.start, *plan.legs):
        yield Waypoint(ToolPose(x, y, low, yaw_rad), tool=True)
    yield Waypoint(ToolPose(*plan.legs[-1], hover, yaw_rad), tool=False)


def _pick_and_place(action: Action) -> Iterator[Waypoint]:
    pick, place = action.pose0_position, action.pose1_position
    hover = tools.HOVER_TIP_Z_M
    yield Waypoint(ToolPose(*pick, hover, action.yaw0_rad), tool=False)
    yield Waypoint(ToolPose(*pick, _DOWN_M, action.yaw0_rad), tool=True, take_hold=True)
    yield Waypoint(ToolPose(*pick, hover, action.yaw0_rad), tool=True)
    yield Waypoint(ToolPose(*place, hover, action.yaw1_rad), tool=True)
    yield Waypoint(ToolPose(*place, _DOWN_M, action.yaw1_rad), tool=True)
    yield Waypoint(ToolPose(*place, hover, action.yaw1_rad), tool=False)


class PathFollower:
    """Follows the path of one primitive, command by command.

    Args:
        action: The primitive.
        end_effector: The tool.
        compat: As in `sweep_plan`.
    """

    def __init__(self, action: Action, end_effector: EndEffector, *, compat: bool = False) -> None:
        self._waypoints = list(tool_path(action, end_effector, compat=compat))
        self._last: ToolPose | None = None  # where the tool was when the waypoint was last pursued

    def next_command(self, world: ToolWorld) -> ToolCommand | None:
        """Return the next command; None once the path is done and everything is at rest."""
        while self._waypoints and self._is_done(self._waypoints[0], world):
            done = self._waypoints.pop(0)
            self._last = None
            if done.take_hold and not world.holds:
                self._waypoints.clear()  # a failed pick
        if not self._waypoints:
            return STAY if world.is_moving else None
        waypoint, self._last = self._waypoints[0], world.pose
        return _towards(waypoint, world.pose)

    def _is_done(self, waypoint: Waypoint, world: ToolWorld) -> bool:
        if waypoint.tool and not waypoint.take_hold and world.is_moving:
            return False
        if waypoint.take_hold and world.holds:
            return True
        is_there = _distance(waypoint.pose, world.pose) < _REACHED and world.holds == waypoint.tool
        return is_there or (self._last is not None and _distance(self._last, world.pose) < _REACHED)


def _towards(waypoint: Waypoint, pose: ToolPose) -> ToolCommand:
    """The fastest command in a straight line, no farther than the waypoint."""
    goal = waypoint.pose
    dx, dy, dz = goal.x - pose.x, goal.y - pose.y, goal.z - pose.z
    turn = goal.yaw_rad - pose.yaw_rad
    slower = max(
        abs(dx) / MAX_MOVE_M, abs(dy) / MAX_MOVE_M, abs(dz) / MAX_MOVE_M, abs(turn) / MAX_TURN_RAD, 1
    )
    return ToolCommand(dx / slower, dy / slower, dz / slower, turn / slower, waypoint.tool)


def _distance(one: ToolPose, other: ToolPose) -> float:
    return max(
        math.dist((one.x, one.y, one.z), (other.x, other.y, other.z)), abs(one.yaw_rad - other.yaw_rad)
    )
