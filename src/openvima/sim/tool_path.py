"""Primitives as sequences of commands: how the oracle acts under low-level control."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from openvima.scene import Action, EndEffector, Pose
from openvima.scene.action import MAX_MOVE_M, MAX_TURN_RAD, STAY, ToolCommand, ToolPose
from openvima.scene.scene import angle_difference
from openvima.sim import ur5
from openvima.sim.tool_world import PRESS_WITHIN_M, ToolWorld
from openvima.sim.world import SweepPlan, sweep_plan

_REACHED = 1e-6  # m and rad
_NEAR_M = 0.02  # from where a path is taken up, rather than begun anew
_NEAR_RAD = 0.2
_FUNNEL = 0.3  # metres that it may be off for each metre above
_CARRY_M = 0.16  # what is held is lifted to here before it moves sideways …
_FAR_M = 0.1  # … farther than this
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


def tool_path(action: Action, end_effector: EndEffector, *, compat: bool = False) -> list[Waypoint]:
    """Return the waypoints of a primitive.

    Args:
        action: The primitive.
        end_effector: The tool.
        compat: As in `sweep_plan`.
    """
    if end_effector == "spatula":
        plan = sweep_plan(action, compat=compat)
        return [] if plan is None else _sweep(plan)
    hover = ur5.HOVER_TIP_Z_M
    pick = ToolPose(*action.pose0_position, hover, action.yaw0_rad)
    return _pick_and_place(pick, ToolPose(*action.pose1_position, hover, action.yaw1_rad))


def onward_path(action: Action, object_id: int, world: ToolWorld, *, compat: bool = False) -> list[Waypoint]:
    """Return the waypoints of a primitive that are left from any state of the tool.

    A tool near the path takes it up where it is. What it holds is carried on, or put down at once if it is
    another object. What moves is left to come to rest before it is touched again.

    Args:
        action: The primitive, from the scene when it was last at rest.
        object_id: The object to pick or to sweep.
        world: The world.
        compat: As in `sweep_plan`.
    """
    pose, tool = world.pose, world.scene.end_effector
    if world.is_moving and not world.holds:
        return [Waypoint(replace(pose, z=ur5.HOVER_TIP_Z_M), tool=False)]
    path = tool_path(action, tool, compat=compat)
    if tool == "spatula":
        return path[_count_passed(path, world) :] if path else []
    if world.grasp is None:
        above, *rest = path
        return rest if _is_above(above.pose, pose) else [_approach(above, pose), *rest]
    place = _carry(world.grasp, action) if world.grasped == object_id else pose
    path = _pick_and_place(pose, replace(place, z=ur5.HOVER_TIP_Z_M))[2:]
    if _is_above(place, pose):
        return path[3 if world.is_down else 2 :]
    lift, above, *rest = path
    is_far = math.dist((place.x, place.y), (pose.x, pose.y)) > _FAR_M
    return [*[lift][: is_far and pose.z < _CARRY_M], _approach(above, pose), *rest]


def _approach(above: Waypoint, pose: ToolPose) -> Waypoint:
    """Go above a goal at the height of the funnel where the tool is, so that commands change steadily."""
    goal = above.pose
    is_turned = angle_difference(goal.yaw_rad, pose.yaw_rad) <= _NEAR_RAD
    height = math.dist((goal.x, goal.y), (pose.x, pose.y)) / _FUNNEL if is_turned else goal.z
    return replace(above, pose=replace(goal, z=min(goal.z, height)))


def _pick_and_place(pick: ToolPose, place: ToolPose) -> list[Waypoint]:
    """Waypoints between poses to hover at."""
    return [
        Waypoint(pick, tool=False),
        Waypoint(replace(pick, z=_DOWN_M), tool=True, take_hold=True),
        Waypoint(replace(pick, z=place.z), tool=True),
        Waypoint(place, tool=True),
        Waypoint(replace(place, z=_DOWN_M), tool=True),
        Waypoint(place, tool=False),
    ]


def _sweep(plan: SweepPlan) -> list[Waypoint]:
    yaw_rad = math.remainder(plan.yaw_rad, math.pi)  # both faces of the spatula are alike
    hover, low = ur5.SWEEP_HOVER_TIP_Z_M, ur5.SWEEP_TIP_Z_M
    return [
        Waypoint(ToolPose(*plan.start, hover, yaw_rad), tool=False),
        Waypoint(ToolPose(*plan.start, low, yaw_rad), tool=False),
        *(Waypoint(ToolPose(x, y, low, yaw_rad), tool=True) for x, y in (plan.start, *plan.legs)),
        Waypoint(ToolPose(*plan.legs[-1], hover, yaw_rad), tool=False),
    ]


def _carry(grasp: ToolPose, action: Action) -> ToolPose:
    """Where a tool that grasped an object has it where an action moves it."""
    before = Pose.planar(*action.pose0_position, action.yaw0_rad)
    after = Pose.planar(*action.pose1_position, action.yaw1_rad)
    moved = after @ before.inverse() @ Pose.planar(grasp.x, grasp.y)
    return ToolPose(moved.x, moved.y, grasp.z, grasp.yaw_rad + action.yaw1_rad - action.yaw0_rad)


def _is_above(goal: ToolPose, pose: ToolPose, period_rad: float = 2 * math.pi) -> bool:
    """Whether a pose is in a funnel above a goal, from where a tool is lowered."""
    turn = angle_difference(goal.yaw_rad, pose.yaw_rad, period_rad)
    near_m = max(_NEAR_M, _FUNNEL * pose.z)
    return math.dist((goal.x, goal.y), (pose.x, pose.y)) <= near_m and turn <= _NEAR_RAD


def _count_passed(path: Sequence[Waypoint], world: ToolWorld) -> int:
    """How many waypoints of a sweep the spatula has behind it."""
    pose, start, end = world.pose, path[0].pose, path[-1].pose
    (x0, y0), (x1, y1) = (start.x, start.y), (end.x, end.y)
    fraction = 0.0
    if world.holds:  # the nearest point of the line
        along = (pose.x - x0) * (x1 - x0) + (pose.y - y0) * (y1 - y0)
        fraction = min(max(along / max(math.dist((x0, y0), (x1, y1)) ** 2, 1e-12), 0.0), 1.0)
    nearest = ToolPose(x0 + fraction * (x1 - x0), y0 + fraction * (y1 - y0), pose.z, start.yaw_rad)
    if not _is_above(nearest, pose, math.pi):
        return 0
    if world.holds:
        return 3
    return 2 if pose.z < ur5.SWEEP_TIP_Z_M + PRESS_WITHIN_M else 1


class PathFollower:
    """Follows waypoints, command by command.

    Args:
        waypoints: The path.
    """

    def __init__(self, waypoints: Iterable[Waypoint]) -> None:
        self._waypoints = list(waypoints)
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
    dx, dy, dz = goal.x - pose.x, goal.y - pose.y, max(goal.z - pose.z, -MAX_MOVE_M)
    turn = goal.yaw_rad - pose.yaw_rad
    slower = max(
        abs(dx) / MAX_MOVE_M, abs(dy) / MAX_MOVE_M, abs(dz) / MAX_MOVE_M, abs(turn) / MAX_TURN_RAD, 1
    )
    return ToolCommand(dx / slower, dy / slower, dz / slower, turn / slower, waypoint.tool)


def _distance(one: ToolPose, other: ToolPose) -> float:
    return max(
        math.dist((one.x, one.y, one.z), (other.x, other.y, other.z)), abs(one.yaw_rad - other.yaw_rad)
    )
