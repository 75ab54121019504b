"""The simulated world, and its two primitives: pick and place with the suction cup, sweep with the spatula.

Event-driven: physics is skipped while nothing can be in contact. A lifted body moves rigidly with the arm;
physics runs when it is released onto anything but bare floor, when the spatula touches bodies, and until
everything is at rest.
"""

import math
from dataclasses import dataclass

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.scene import Action, Point, Pose, Scene
from openvima.scene.action import ToolPose
from openvima.sim import ur5
from openvima.sim.bodies import Bodies, body_gap, distance_to_contact, gap
from openvima.sim.model import FLOOR_Z_M
from openvima.sim.primitive_state import (
    RESTING_GAP_M,
    Monitor,
    PrimitiveState,
    RecordFrame,
    is_at_rest,
    is_level,
    reachable_joints,
)
from openvima.sim.spatula import Spatula

_DOWN = (0.0, 0.0, -1.0)
_ABOVE_ALL_M = 1.0  # height from which tools and held bodies are lowered, above every stack


def pick_place(state: PrimitiveState, action: Action) -> int | None:
    """Lower the suction cup at pose0, lift the grasped body, and set it down at pose1.

    The body keeps its pose relative to the tool and is released at first contact.

    Args:
        state: Bodies and arm; afterwards everything is at rest.
        action: Where to pick and to place.

    Returns:
        Index of the moved body; None if the cup hit the floor or a fixed body.
    """
    bodies = state.bodies
    x, y = action.pose0_position
    hover = reachable_joints(x, y, ur5.HOVER_TIP_Z_M, action.yaw0_rad)
    state.move(hover)
    caught, surface_z = body_under_probe(bodies, x, y)
    contact_z = surface_z + ur5.PROBE_BELOW_TIP_M
    state.move(reachable_joints(x, y, contact_z, action.yaw0_rad))
    if caught is None or caught not in bodies.rigid:
        state.move(hover)
        return None
    held = HeldBody(caught, bodies.pose(caught), ToolPose(x, y, contact_z, action.yaw0_rad))
    stands_alone, carries_others = take_out(bodies, held)
    if carries_others:
        state.settle((held.index, held.grasped_at.moved(dz=ur5.HOVER_TIP_Z_M)))
    state.move(hover, scene=lambda joints: state.scene(held.at(joints)))
    _set_down(state, held, action, stands_alone=stands_alone)
    return caught


def body_under_probe(bodies: Bodies, x: float, y: float) -> tuple[int | None, float]:
    """Find the body that a probe lowered at (x, y), in metres, hits, and at what height.

    Of the bodies that the probe hits, the highest; if it hits none, the nearest within the capture radius. On
    its way down to a fixed body, such as the floor of a container, it grasps a free one close beside it.
    Distances include contact margins, so hulls are grasped up to 4 mm beside their edge.

    Returns:
        Index of the body, or None for the floor; height of its surface in metres.
    """
    gaps = _gaps_to_axis(bodies, x, y)
    nearest = min(gaps, key=gaps.__getitem__, default=None)
    if nearest is None or gaps[nearest] > ur5.CAPTURE_RADIUS_M:
        return None, FLOOR_Z_M
    tops = {
        index: _surface_z(bodies, index, x, y) for index in gaps if gaps[index] <= ur5.CONTACT_RADIUS_M
    } or {nearest: _surface_z(bodies, nearest, x, y)}
    highest = max(tops, key=tops.__getitem__)
    if highest not in bodies.rigid:
        beside = {index: gaps[index] for index in gaps if index in bodies.rigid}
        flank = min(beside, key=beside.__getitem__, default=highest)
        top = bodies.highest_z(flank)
        if gaps[flank] <= ur5.FLANK_RADIUS_M and top > tops[highest]:
            return flank, top
    return highest, tops[highest]


def _gaps_to_axis(bodies: Bodies, x: float, y: float) -> dict[int, float]:
    """Distances in metres of the bodies near a vertical line to it; negative where it pierces one."""
    bodies.place_probe(x, y, FLOOR_Z_M)
    bodies.refresh()
    probe = bodies.probe_geom
    return {
        index: min((gap(bodies, probe, geom) for geom in bodies.geoms[index]), default=math.inf)
        for index, shape in enumerate(bodies.shapes)
        if math.hypot(bodies.pose(index).x - x, bodies.pose(index).y - y)
        < shape.radius_m + ur5.CAPTURE_RADIUS_M
    }


def _surface_z(bodies: Bodies, index: int, x: float, y: float) -> float:
    """Height at which a probe lowered at (x, y) hits a body; the top of the body if it misses."""
    bodies.place_probe(x, y, _ABOVE_ALL_M)
    bodies.refresh()
    probe = (bodies.probe_geom,)
    depth = _ABOVE_ALL_M - FLOOR_Z_M
    drop = distance_to_contact(bodies, probe, bodies.geoms[index], direction=_DOWN, length_m=depth)
    return bodies.highest_z(index) if math.isinf(drop) else _ABOVE_ALL_M - drop


@dataclass(frozen=True, slots=True)
class HeldBody:
    """A body on the suction cup.

    Args:
        index: Its index.
        grasped_at: Its pose at the grasp.
        grasp: Pose of the tool at the grasp.
    """

    index: int
    grasped_at: Pose
    grasp: ToolPose

    def at(self, joints: np.ndarray) -> tuple[int, Pose]:
        """Index and pose for the arm at `joints`."""
        tip = ur5.tool_pose(self.grasp.x, self.grasp.y, self.grasp.z, self.grasp.yaw_rad)
        return self.index, ur5.forward(joints) @ tip.inverse() @ self.grasped_at

    def carried(self, x: float, y: float, yaw_rad: float) -> Pose:
        """Pose with the tool above a point, at the height of the grasp."""
        pick = Pose.planar(self.grasp.x, self.grasp.y, self.grasp.yaw_rad)
        return Pose.planar(x, y, yaw_rad) @ pick.inverse() @ self.grasped_at

    def lowest(self, bodies: Bodies, x: float, y: float, yaw_rad: float) -> tuple[Pose, bool]:
        """Pose at first contact when lowered at a point, and whether that is with bare floor.

        The body is left high above; place or park it.
        """
        target = self.carried(x, y, yaw_rad)
        above = target.moved(dz=_ABOVE_ALL_M)
        bodies.place(self.index, above)
        bodies.refresh()
        to_floor = above.z + bodies.lowest_z(self.index, above.quaternion) - FLOOR_Z_M
        reach = bodies.shapes[self.index].radius_m
        others = [
            geom
            for other, shape in enumerate(bodies.shapes)
            if other != self.index and bodies.pose(other).planar_distance(above) < reach + shape.radius_m
            for geom in bodies.geoms[other]
        ]
        moving = bodies.geoms[self.index]
        to_others = distance_to_contact(bodies, moving, others, direction=_DOWN, length_m=to_floor)
        drop = min(to_floor, to_others)
        return target.moved(dz=_ABOVE_ALL_M - drop), math.isinf(to_others)


def take_out(bodies: Bodies, held: HeldBody) -> tuple[bool, bool]:
    """Take a grasped body out of the physics.

    Returns:
        Whether it lay flat on the floor and touched no other; whether it touched a free one.
    """
    touching = [
        other
        for other in range(len(bodies.shapes))
        if other != held.index and body_gap(bodies, held.index, other) < RESTING_GAP_M
    ]
    on_floor = held.grasped_at.z + bodies.lowest_z(held.index, held.grasped_at.quaternion) - FLOOR_Z_M
    bodies.park(held.index)
    stands_alone = not touching and on_floor < RESTING_GAP_M and is_level(held.grasped_at)
    return stands_alone, any(other in bodies.rigid for other in touching)


def _set_down(state: PrimitiveState, held: HeldBody, action: Action, *, stands_alone: bool) -> None:
    """Carry a body to pose1, lower it to first contact, release it and settle."""
    bodies = state.bodies
    x, y = action.pose1_position
    yaw_rad = action.yaw1_rad
    target = held.carried(x, y, yaw_rad)
    set_down_at, on_floor = held.lowest(bodies, x, y, yaw_rad)
    hover = reachable_joints(x, y, ur5.HOVER_TIP_Z_M, yaw_rad)
    contact_z = held.grasp.z + set_down_at.z - target.z
    state.move(hover, scene=lambda joints: state.scene(held.at(joints)))
    state.move(reachable_joints(x, y, contact_z, yaw_rad), scene=lambda joints: state.scene(held.at(joints)))
    if on_floor and stands_alone:  # no physics needed, and its height keeps the same value
        bodies.place(held.index, target)
        bodies.refresh()
    else:
        bodies.place(held.index, set_down_at)
        bodies.refresh()
        state.settle()
    state.move(hover, scene=lambda _: state.scene())


def sweep(state: PrimitiveState, action: Action, *, compat: bool = False) -> None:
    """Push with the spatula from just before pose0 towards pose1, in a straight line at constant speed.

    Rotations of the action are ignored. Nothing happens if the two points are equal.

    Args:
        state: Bodies and arm; afterwards everything is at rest.
        action: Start and end.
        compat: Move straight in joint space, as VIMA-Bench does, and stop 3 mm earlier.
    """
    plan = sweep_plan(action, compat=compat)
    if plan is None:
        return
    spatula = Spatula(state, plan.yaw_rad, in_joint_space=compat)
    spatula.lower(*plan.start)
    for x, y in plan.legs:
        spatula.push(x, y)
    spatula.lift()


@dataclass(frozen=True, slots=True)
class SweepPlan:
    """The spatula's way in one sweep.

    Args:
        yaw_rad: Heading.
        start: Where the spatula is lowered, x and y in metres.
        legs: Ends of the straight lines along which it then moves.
    """

    yaw_rad: float
    start: Point
    legs: tuple[Point, ...]


def sweep_plan(action: Action, *, compat: bool = False) -> SweepPlan | None:
    """Return the way of the spatula in a sweep; None if the two points are equal.

    Args:
        action: Start and end.
        compat: Stop 3 mm earlier.
    """
    (x0, y0), (x1, y1) = action.pose0_position, action.pose1_position
    distance = math.hypot(x1 - x0, y1 - y0)
    if distance == 0:
        return None
    shortfall_m = ur5.SPATULA_SHORTFALL_M + (ur5.COMPAT_SHORTFALL_M if compat else 0.0)
    vx, vy = (x1 - x0) / distance, (y1 - y0) / distance
    start = _within_reach(x0 - ur5.SPATULA_RUN_UP_M * vx, y0 - ur5.SPATULA_RUN_UP_M * vy)
    end = _within_reach(x1 - shortfall_m * vx, y1 - shortfall_m * vy)
    # A sweep shorter than run-up and shortfall overshoots, then returns, as in VIMA-Bench.
    nudge = distance + ur5.SPATULA_RUN_UP_M - shortfall_m
    overshoot = () if nudge >= 0 else (_within_reach(start[0] - nudge * vx, start[1] - nudge * vy),)
    return SweepPlan(math.atan2(vy, vx), start, (*overshoot, end))


def _within_reach(x: float, y: float) -> Point:
    """Move a point towards the base until the lowered tool reaches it."""
    farthest = ur5.farthest_tip_distance(ur5.SWEEP_TIP_Z_M) - 1e-6
    shrink = min(1.0, farthest / math.hypot(x, y))
    return x * shrink, y * shrink


SEPARATION_SPEED = 0.1  # m/s, of bodies that overlap at the start, as in VIMA-Bench


@dataclass(frozen=True, slots=True, eq=False)
class Execution:
    """Result of one primitive.

    Args:
        grasped: Id of the lifted object; None without one, and always for the spatula.
        joint_path: Waypoints of the arm, shape (W, 6), float32, radians, joined by straight lines in joint
            space (straight lines of the tool while sweeping).
        num_ticks: Number of physics ticks of 1/240 s.
    """

    grasped: int | None
    joint_path: np.ndarray
    num_ticks: int


class World:
    """The table with its objects and the robot.

    Deterministic: equal scenes, assets and actions give equal bytes.

    Args:
        scene: The objects at the start. Those that hover or overlap settle in the first primitive.
        assets: Asset pack.
        compat: Move the spatula straight in joint space, as VIMA-Bench's arm does, and stop it 3 mm earlier.

    Attributes:
        scene: The current scene.

    Raises:
        UnknownNameError: An object is not in the catalogue.
        AssetError: The asset pack lacks a file.

    Example:
        >>> world = World(scene, assets)  # doctest: +SKIP
        >>> world.execute(Action.planar((0.4, 0.1), (0.6, -0.2), yaw_rad=0.5)).grasped  # doctest: +SKIP
        5
    """

    def __init__(self, scene: Scene, assets: Assets, *, compat: bool = False) -> None:
        self.scene = scene
        self._bodies = Bodies(scene, assets)
        self._compat = compat
        self._joints = ur5.HOME
        self._is_settled = is_at_rest(self._bodies)

    @property
    def joints(self) -> np.ndarray:
        """Current joint angles of the arm, shape (6,), float64, radians."""
        return self._joints.copy()

    def execute(
        self,
        action: Action,
        *,
        monitor: Monitor | None = None,
        record: RecordFrame | None = None,
    ) -> Execution:
        """Execute one action: pick and place, or sweep, depending on the end effector.

        Monitoring and recording do not change the result.

        Args:
            action: The action; positions lie in the workspace.
            monitor: Called with the scene at least every 25 ticks while bodies may move, and at the end.
            record: Called with scene and joints, shape (6,), for every video frame, 30 a second.

        Returns:
            The result; `scene` and `joints` are updated.
        """
        state = PrimitiveState(self.scene, self._bodies, [self._joints], monitor, record)
        if not self._is_settled:
            state.settle(max_speed=SEPARATION_SPEED)
            self._is_settled = True
        grasped = None
        if self.scene.end_effector == "suction":
            grasped = pick_place(state, action)
        else:
            sweep(state, action, compat=self._compat)
        self.scene = state.finish()
        self._joints = state.waypoints[-1]
        grasped_id = None if grasped is None else state.placement(grasped).id
        return Execution(grasped_id, np.array(state.waypoints, np.float32), state.num_ticks)
