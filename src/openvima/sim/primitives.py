"""The two primitives: pick and place with the suction cup, sweep with the spatula.

Events, not time: while nothing can be touched, nothing is stepped. A lifted body moves rigidly with the arm;
physics runs when it is let go onto something else than bare floor, while the blade pushes, and until all is
at rest.
"""

import math
from dataclasses import dataclass

import numpy as np

from openvima.scene import Action, Pose
from openvima.scene.pose import rotate
from openvima.sim import end_effectors as tools
from openvima.sim import settling, ur5
from openvima.sim.arm_path import SWEEP_SPEED, reachable_joints
from openvima.sim.bodies import Bodies
from openvima.sim.model import FLOOR_Z_M, TICK_S
from openvima.sim.stage import RESTING_GAP_M, Stage
from openvima.sim.touch import body_gap, gap, way_to_touch

SWEEP_M_S = 0.12  # 0.5 mm a tick; VIMA-Bench takes 350–430 ticks for 0.2 m
TOP_SPEED = 0.5  # m/s, of bodies that slip out between the blade and something fixed
_DOWN = (0.0, 0.0, -1.0)
_ABOVE_ALL_M = 1.0  # height from which tools and held bodies are lowered, above every stack


def pick_place(stage: Stage, action: Action) -> int | None:
    """Lower the suction cup at pose0, lift what it caught, and set it down at pose1.

    The caught body keeps its pose relative to the tool and is let go when it first touches anything.

    Args:
        stage: Bodies and arm; afterwards all is at rest.
        action: Where to pick and to place.

    Returns:
        Index of the body that was moved; None if the cup met the floor or a fixed body.
    """
    bodies, path = stage.bodies, stage.path
    x, y = action.pose0_position
    hover = reachable_joints(x, y, tools.HOVER_TIP_Z_M, action.yaw0_rad)
    path.move(hover, scene=lambda _: stage.start)
    caught, surface_z = body_under_needle(bodies, x, y)
    touch_z = surface_z + tools.NEEDLE_BELOW_TIP_M
    path.move(reachable_joints(x, y, touch_z, action.yaw0_rad), scene=lambda _: stage.start)
    if caught is None or caught not in bodies.rigid:
        path.move(hover, scene=lambda _: stage.start)
        return None
    held = _HeldBody(caught, bodies.pose(caught), action, touch_z)
    stands_alone = _lift(stage, held)
    path.move(hover, scene=lambda joints: stage.scene(held.at(joints)))
    _set_down(stage, held, stands_alone=stands_alone)
    return caught


def body_under_needle(bodies: Bodies, x: float, y: float) -> tuple[int | None, float]:
    """Which body a needle meets that is lowered at (x, y), in metres, and at what height.

    Of the bodies that the needle hits, the highest; if it hits none, the nearest within the capture radius.
    Distances count from where a body touches, so hulls are caught up to 4 mm beside their edge.

    Returns:
        Index of the body, or None for the floor; height of its surface in metres.
    """
    gaps = _gaps_to_axis(bodies, x, y)
    nearest = min(gaps, key=gaps.__getitem__, default=None)
    if nearest is None or gaps[nearest] > tools.CAPTURE_RADIUS_M:
        return None, FLOOR_Z_M
    tops = {
        index: _surface_z(bodies, index, x, y) for index in gaps if gaps[index] <= tools.TOUCH_RADIUS_M
    } or {nearest: _surface_z(bodies, nearest, x, y)}
    highest = max(tops, key=tops.__getitem__)
    return highest, tops[highest]


def _gaps_to_axis(bodies: Bodies, x: float, y: float) -> dict[int, float]:
    """Distances in metres of the bodies near a vertical line to it; negative where it pierces one."""
    bodies.place_needle(x, y, FLOOR_Z_M)
    bodies.refresh()
    needle = bodies.needle_geom
    return {
        index: min((gap(bodies, needle, geom) for geom in bodies.geoms(index)), default=math.inf)
        for index, shape in enumerate(bodies.shapes)
        if math.hypot(bodies.pose(index).x - x, bodies.pose(index).y - y)
        < shape.radius_m + tools.CAPTURE_RADIUS_M
    }


def _surface_z(bodies: Bodies, index: int, x: float, y: float) -> float:
    """Height at which a needle lowered at (x, y) meets a body; of the top if it goes down beside it."""
    bodies.place_needle(x, y, _ABOVE_ALL_M)
    bodies.refresh()
    needle = (bodies.needle_geom,)
    depth = _ABOVE_ALL_M - FLOOR_Z_M
    way = way_to_touch(bodies, needle, bodies.geoms(index), direction=_DOWN, length_m=depth)
    return bodies.highest_z(index) if way is None else _ABOVE_ALL_M - way


@dataclass(frozen=True, slots=True)
class _HeldBody:
    """A body on the suction cup: its pose at the grasp, the action, and the tip's height at the grasp."""

    index: int
    grasped_at: Pose
    action: Action
    touch_z: float

    def at(self, joints: np.ndarray) -> tuple[int, Pose]:
        """Index and pose when the arm stands at `joints`."""
        x, y = self.action.pose0_position
        tip = ur5.tool_pose(x, y, self.touch_z, self.action.yaw0_rad)
        return self.index, ur5.forward(joints) @ tip.inverse() @ self.grasped_at

    def target(self) -> Pose:
        """Pose above pose1 at the height of the grasp: the grasp pose carried along with the tool."""
        pick = Pose.planar(*self.action.pose0_position, self.action.yaw0_rad)
        place = Pose.planar(*self.action.pose1_position, self.action.yaw1_rad)
        return place @ pick.inverse() @ self.grasped_at


def _lift(stage: Stage, held: _HeldBody) -> bool:
    """Take a body out of the physics, let others settle that leaned on it; whether it stood by itself."""
    bodies = stage.bodies
    touching = [
        other
        for other in range(len(bodies.shapes))
        if other != held.index and body_gap(bodies, held.index, other) < RESTING_GAP_M
    ]
    on_floor = held.grasped_at.z + bodies.lowest_z(held.index, held.grasped_at.quaternion) - FLOOR_Z_M
    bodies.park(held.index)
    if any(other in bodies.rigid for other in touching):
        stage.settle((held.index, held.grasped_at.moved(dz=tools.HOVER_TIP_Z_M)))
    return not touching and on_floor < RESTING_GAP_M


def _set_down(stage: Stage, held: _HeldBody, *, stands_alone: bool) -> None:
    """Carry a body to pose1, lower it until it touches, let it go and wait until all is at rest."""
    bodies, path = stage.bodies, stage.path
    x, y = held.action.pose1_position
    yaw_rad = held.action.yaw1_rad
    target = held.target()
    drop, on_floor = _way_down(bodies, held.index, target.moved(dz=_ABOVE_ALL_M))
    set_down_at = target.moved(dz=_ABOVE_ALL_M - drop)
    hover = reachable_joints(x, y, tools.HOVER_TIP_Z_M, yaw_rad)
    touch_z = held.touch_z + set_down_at.z - target.z
    path.move(hover, scene=lambda joints: stage.scene(held.at(joints)))
    path.move(reachable_joints(x, y, touch_z, yaw_rad), scene=lambda joints: stage.scene(held.at(joints)))
    if (
        on_floor and stands_alone
    ):  # as it stood before: no physics needed, and its height stays the same number
        bodies.place(held.index, target)
        bodies.refresh()
    else:
        bodies.place(held.index, set_down_at)
        bodies.refresh()
        stage.settle()
    after = stage.scene() if path.is_filmed else stage.start
    path.move(hover, scene=lambda _: after)


def _way_down(bodies: Bodies, index: int, above: Pose) -> tuple[float, bool]:
    """How far a body can be lowered from `above` until it touches, and whether that is bare floor."""
    bodies.place(index, above)
    bodies.refresh()
    to_floor = above.z + bodies.lowest_z(index, above.quaternion) - FLOOR_Z_M
    reach = bodies.shapes[index].radius_m
    others = [
        geom
        for other, shape in enumerate(bodies.shapes)
        if other != index and bodies.pose(other).planar_distance(above) < reach + shape.radius_m
        for geom in bodies.geoms(other)
    ]
    to_others = way_to_touch(bodies, bodies.geoms(index), others, direction=_DOWN, length_m=to_floor)
    if to_others is None:
        return to_floor, True
    return min(to_floor, to_others), False


def sweep(stage: Stage, action: Action, *, shortfall_m: float = tools.BLADE_SHORTFALL_M) -> None:
    """Push with the blade from just before pose0 towards pose1, in a straight line and at constant speed.

    Rotations of the action do not matter. If the two points are the same there is no direction: nothing
    happens.

    Args:
        stage: Bodies and arm; afterwards all is at rest.
        action: From where to where.
        shortfall_m: How far before pose1 the blade stops.
    """
    (x0, y0), (x1, y1) = action.pose0_position, action.pose1_position
    distance = math.hypot(x1 - x0, y1 - y0)
    if distance == 0:
        return
    vx, vy = (x1 - x0) / distance, (y1 - y0) / distance
    start = _within_reach(x0 - tools.BLADE_RUN_UP_M * vx, y0 - tools.BLADE_RUN_UP_M * vy)
    end = _within_reach(x1 - shortfall_m * vx, y1 - shortfall_m * vy)
    # A sweep shorter than run-up and shortfall first goes forward by what is missing, then back, as
    # VIMA-Bench does.
    nudge = distance + tools.BLADE_RUN_UP_M - shortfall_m
    legs = [end] if nudge >= 0 else [_within_reach(start[0] - nudge * vx, start[1] - nudge * vy), end]
    blade = _Blade(stage, math.atan2(vy, vx))
    blade.lower(*start)
    for x, y in legs:
        blade.push(x, y)
    blade.lift()


def _within_reach(x: float, y: float) -> tuple[float, float]:
    """Move a point towards the base until the lowered tool reaches it."""
    farthest = ur5.farthest_tip_distance(tools.SWEEP_TIP_Z_M) - 1e-6
    shrink = min(1.0, farthest / math.hypot(x, y))
    return x * shrink, y * shrink


class _Blade:
    """The spatula's blade during one sweep: where it is, and how it moves."""

    def __init__(self, stage: Stage, yaw_rad: float) -> None:
        self._stage = stage
        self._bodies = stage.bodies
        self._yaw_rad = yaw_rad
        self._x = self._y = 0.0
        self._tip_z = tools.SWEEP_HOVER_TIP_Z_M
        self._pushed = tuple(geom for index in stage.bodies.rigid for geom in stage.bodies.geoms(index))

    def lower(self, x: float, y: float) -> None:
        """Bring the blade down at a point, onto whatever is there."""
        self._x, self._y = x, y
        path, scene = self._stage.path, self._stage.start
        path.move(self._joints(), scene=lambda _: scene)
        down = reachable_joints(x, y, tools.SWEEP_TIP_Z_M, self._yaw_rad)
        path.move(down, scene=lambda _: scene)
        self._tip_z = tools.SWEEP_TIP_Z_M
        in_the_way = [index for index in self._bodies.rigid if self._make_room(index)]
        if in_the_way:
            self._wait()

    def push(self, x: float, y: float) -> None:
        """Move the lowered blade to a point in a straight line."""
        while (left := math.hypot(x - self._x, y - self._y)) > 1e-9:
            direction = ((x - self._x) / left, (y - self._y) / left, 0.0)
            if self._is_calm():
                left = self._slide(direction, left)
            ticks = min(settling.WATCH_TICKS, max(1, math.ceil(left / (SWEEP_M_S * TICK_S) - 1e-9)))
            way = min(left, ticks * SWEEP_M_S * TICK_S)
            if way > 0:
                self._press(direction, way, way / (ticks * TICK_S))
        self._x, self._y = x, y
        self._stage.path.waypoints.append(self._joints())

    def lift(self) -> None:
        """Take the blade away and wait until all is at rest."""
        stage = self._stage
        self._bodies.park_blade()
        if stage.num_ticks:
            stage.settle(top_speed=TOP_SPEED)
        after = stage.scene() if stage.path.is_filmed else stage.start
        self._tip_z = tools.SWEEP_HOVER_TIP_Z_M
        stage.path.move(self._joints(), scene=lambda _: after)

    def _make_room(self, index: int) -> bool:
        """Shift a body that stands where the blade comes down to its nearest side; whether it did.

        Squeezing a body between blade and floor in the physics would fling it away; in VIMA-Bench, it is
        nudged.
        """
        pose = self._bodies.pose(index)
        blade = self._pose()
        corners = blade.inverse().transform(pose.transform(self._bodies.shapes[index].points[:, :3]))
        half = np.array(tools.BLADE_HALF_SIZE_M)
        low, high = corners.min(axis=0) - half, corners.max(axis=0) + half  # body grown by the blade
        if (low >= 0).any() or (high <= 0).any():
            return False
        shifts = [(-low[0], 0.0), (-high[0], 0.0), (0.0, -low[1]), (0.0, -high[1])]
        along, across = min(shifts, key=lambda shift: abs(shift[0]) + abs(shift[1]))
        dx, dy, _ = rotate(blade.quaternion, (along, across, 0.0))
        self._bodies.place(index, pose.moved(dx, dy))
        return True

    def _wait(self) -> None:
        """Run physics with the blade at rest until all others are, too."""
        for _ in range(settling.SETTLE_LIMIT_TICKS // settling.STRIDE_TICKS):
            self._run(settling.STRIDE_TICKS, (0.0, 0.0, 0.0))
            if self._is_calm():
                return

    def _slide(self, direction: tuple[float, float, float], length: float) -> float:
        """Move on, without physics, to just before the first body; return the way that is left."""
        self._bodies.stop()
        self._bodies.place_blade(self._pose())
        self._bodies.refresh()
        free = way_to_touch(
            self._bodies, (self._bodies.blade_geom,), self._pushed, direction=direction, length_m=length
        )
        way = length if free is None else free
        self._film(direction, way)
        self._x += direction[0] * way
        self._y += direction[1] * way
        return length - way

    def _press(self, direction: tuple[float, float, float], length: float, speed: float) -> None:
        """Move on by a length under physics, at constant speed whatever stands in the way."""
        left = max(1, round(length / (speed * TICK_S)))
        step = length / left
        velocity = (direction[0] * speed, direction[1] * speed, 0.0)
        while left:
            ticks = min(settling.STRIDE_TICKS, left)
            self._run(ticks, velocity)
            left -= ticks
            self._x += direction[0] * step * ticks
            self._y += direction[1] * step * ticks

    def _run(self, num_ticks: int, velocity: tuple[float, float, float]) -> None:
        self._bodies.tick_with_blade(self._pose(), velocity, num_ticks=num_ticks, top_speed=TOP_SPEED)
        self._stage.count_ticks(num_ticks)
        self._stage.path.stay(num_ticks, scene=self._stage.scene, joints=self._joints)

    def _film(self, direction: tuple[float, float, float], length: float) -> None:
        """Record the frames of a stretch in which nothing is touched."""
        stage = self._stage
        if not stage.path.is_filmed or length <= 0:
            return
        x, y = self._x + direction[0] * length, self._y + direction[1] * length
        scene = stage.scene()
        joints = reachable_joints(x, y, self._tip_z, self._yaw_rad)
        stage.path.move(joints, scene=lambda _: scene, speed=SWEEP_SPEED)
        stage.path.waypoints.pop()

    def _is_calm(self) -> bool:
        speed, turning = self._bodies.speeds()
        return speed < settling.SETTLED_SPEED and turning < settling.SETTLED_TURNING

    def _joints(self) -> np.ndarray:
        return reachable_joints(self._x, self._y, self._tip_z, self._yaw_rad)

    def _pose(self) -> Pose:
        return Pose.planar(self._x, self._y, self._yaw_rad, z=tools.blade_centre_z(self._tip_z))
