"""The spatula's blade during one sweep: how it moves, and what it takes along.

Physics runs while something changes. The blade goes without it up to the first body; bodies that ride along,
flat against the blade, are carried without it until the next one comes within reach.
"""

import math

import numpy as np

from openvima.catalog.geometry import Vector3
from openvima.scene import Pose
from openvima.scene.pose import rotate
from openvima.sim import end_effectors as tools
from openvima.sim import settling, ur5
from openvima.sim.arm_path import SWEEP_SPEED, reachable_joints
from openvima.sim.contacts import way_to_touch
from openvima.sim.model import TICK_S
from openvima.sim.stage import Stage

SWEEP_M_S = 0.12  # 0.5 mm a tick; VIMA-Bench takes 350–430 ticks for 0.2 m
TOP_SPEED = 0.5  # m/s, of bodies that slip out between the blade and something fixed
# Bodies that the blade pushes tremble, but hardly shift on it. Riding without physics halves the ticks of a
# sweep and moves where bodies end by as much as a blade that is faster by 1 % would (1.3 mm in the median,
# 8 mm at most).
RIDING_M = 3e-4  # bodies that shift against the blade by less than this, and turn by less than …
RIDING_RAD = 7.5e-3  # … this …
_RIDING_STRIDES = 4  # … in so many strides of physics, ride along: they stay where they are on it
_LONGEST_RIDE_M = 0.05  # then physics runs again, so that slow slipping is not lost
_SHORTEST_RIDE_M = 0.003  # finding out how far it may go costs as much as a few ticks
_LOW_TIP_Z_M = 0.035  # the blade's edge is then above the blocks, just
_BOW_STEP_M = 0.004  # a bow is gone along in straight pieces of this length
_NUM_BOW_POINTS = 400  # of a bow at which the arm's position is computed


class Blade:
    """The blade during one sweep.

    Args:
        stage: Bodies and arm.
        yaw_rad: Heading of the sweep.
        in_bows: Move straight in joint space, as VIMA-Bench's arm does, which takes the blade some
            centimetres off its line halfway through a long sweep; else straight down, along and up.
    """

    def __init__(self, stage: Stage, yaw_rad: float, *, in_bows: bool = False) -> None:
        self._stage = stage
        self._bodies = stage.bodies
        self._yaw_rad = yaw_rad
        self._in_bows = in_bows
        self._tip: Vector3 = (0.0, 0.0, tools.SWEEP_HOVER_TIP_Z_M)
        self._recent: list[tuple[np.ndarray, Vector3]] = []  # coordinates and tip before the last strides
        self._pushed = tuple(geom for index in stage.bodies.rigid for geom in stage.bodies.geoms(index))

    def lower(self, x: float, y: float) -> None:
        """Bring the blade down at a point, onto whatever is there."""
        path, scene = self._stage.path, self._stage.start
        hover = self._joints_at(x, y, tools.SWEEP_HOVER_TIP_Z_M)
        down = self._joints_at(x, y, tools.SWEEP_TIP_Z_M)
        path.move(hover, scene=lambda _: scene)
        path.move(down, scene=lambda _: scene)
        way = [point for point in _bow(hover, down) if point[2] < _LOW_TIP_Z_M] if self._in_bows else []
        self._tip, *rest = [*way, (x, y, tools.SWEEP_TIP_Z_M)]
        in_the_way = [index for index in self._bodies.rigid if self._make_room(index)]
        if in_the_way:
            self._wait()
        for point in rest:
            self._push_to(point)

    def push(self, x: float, y: float) -> None:
        """Move the lowered blade to a point."""
        target = self._joints_at(x, y, tools.SWEEP_TIP_Z_M)
        for point in _bow(self._joints(), target) if self._in_bows else []:
            self._push_to(point)
        self._push_to((x, y, tools.SWEEP_TIP_Z_M))
        self._stage.path.waypoints.append(target)

    def lift(self) -> None:
        """Take the blade away and wait until all is at rest."""
        stage = self._stage
        hover = self._joints_at(self._tip[0], self._tip[1], tools.SWEEP_HOVER_TIP_Z_M)
        for point in _bow(self._joints(), hover) if self._in_bows else []:
            if point[2] > _LOW_TIP_Z_M:
                break
            self._push_to(point)
        self._bodies.park_blade()
        if stage.num_ticks:
            stage.settle(top_speed=TOP_SPEED)
        after = stage.scene() if stage.path.is_filmed else stage.start
        stage.path.move(hover, scene=lambda _: after)

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
        if (low[:2] >= 0).any() or (high[:2] <= 0).any():
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

    def _push_to(self, target: Vector3) -> None:
        """Move on in a straight line to a point of the tip, whatever stands in the way."""
        while (left := math.dist(target, self._tip)) > 1e-9:
            direction = _direction(self._tip, target, left)
            if self._is_calm():
                left = self._slide(direction, left)
            elif left > _SHORTEST_RIDE_M and (riders := self._riders()) is not None:
                left -= self._ride(riders, direction, min(left, _LONGEST_RIDE_M))
            ticks = min(settling.STRIDE_TICKS, max(1, math.ceil(left / (SWEEP_M_S * TICK_S) - 1e-9)))
            way = min(left, ticks * SWEEP_M_S * TICK_S)
            if way > 0:
                self._press(direction, way, ticks)
        self._tip = target

    def _slide(self, direction: Vector3, length: float) -> float:
        """Move on, without physics, to just before the first body; return the way that is left."""
        self._recent.clear()
        self._bodies.stop()
        self._bodies.place_blade(self._pose())
        self._bodies.refresh()
        free = way_to_touch(
            self._bodies, (self._bodies.blade_geom,), self._pushed, direction=direction, length_m=length
        )
        way = length if free is None else free
        self._film(direction, way)
        self._tip = _moved(self._tip, direction, way)
        return length - way

    def _riders(self) -> tuple[int, ...] | None:
        """The bodies that ride along; None as long as any body neither does so nor stands still."""
        if len(self._recent) < _RIDING_STRIDES:
            return None
        before, tip = self._recent[-_RIDING_STRIDES]
        change = self._bodies.coordinates() - before
        stands = np.abs(change[:, :3]).max(axis=1) < RIDING_M
        rides = np.abs(change[:, :3] - np.subtract(self._tip, tip)).max(axis=1) < RIDING_M
        turns = 2 * np.abs(change[:, 3:]).max(axis=1) >= RIDING_RAD
        if turns.any() or not (stands | rides).all():
            return None
        return tuple(
            index for index, riding in zip(self._bodies.rigid, rides.tolist(), strict=True) if riding
        )

    def _ride(self, riders: tuple[int, ...], direction: Vector3, length: float) -> float:
        """Carry bodies along, without physics, to just before the next one; return how far."""
        self._recent.clear()
        way = self._way_to_next(riders, direction, length)
        if way < _SHORTEST_RIDE_M:
            return 0.0
        self._stage.look()
        left, longest = way, settling.WATCH_TICKS * SWEEP_M_S * TICK_S
        while left > 0:
            piece = min(left, longest)
            self._bodies.shift(riders, _moved((0.0, 0.0, 0.0), direction, piece))
            self._tip = _moved(self._tip, direction, piece)
            left -= piece
            self._stage.look()
            num_ticks = max(1, round(piece / (SWEEP_M_S * TICK_S)))
            self._stage.path.stay(num_ticks, scene=self._stage.scene, joints=self._joints)
        return way

    def _way_to_next(self, riders: tuple[int, ...], direction: Vector3, length: float) -> float:
        """How far blade and riders can move, at most `length`, before one of them touches another body."""
        bodies = self._bodies
        bodies.place_blade(self._pose())
        bodies.refresh()
        others = [index for index in range(len(bodies.shapes)) if index not in riders]
        fixed = [geom for index in others if index not in bodies.rigid for geom in bodies.geoms(index)]
        free = [geom for index in others if index in bodies.rigid for geom in bodies.geoms(index)]
        riding = [geom for index in riders for geom in bodies.geoms(index)]
        ways = (
            way_to_touch(bodies, (bodies.blade_geom,), free, direction=direction, length_m=length),
            way_to_touch(bodies, riding, [*free, *fixed], direction=direction, length_m=length),
        )
        return min((way for way in ways if way is not None), default=length)

    def _press(self, direction: Vector3, length: float, num_ticks: int) -> None:
        """Move on by a length under physics, at constant speed whatever stands in the way."""
        self._recent = [*self._recent[1 - _RIDING_STRIDES :], (self._bodies.coordinates(), self._tip)]
        speed = length / (num_ticks * TICK_S)
        self._run(num_ticks, _moved((0.0, 0.0, 0.0), direction, speed))
        self._tip = _moved(self._tip, direction, length)

    def _run(self, num_ticks: int, velocity: Vector3) -> None:
        self._bodies.tick_with_blade(self._pose(), velocity, num_ticks=num_ticks, top_speed=TOP_SPEED)
        self._stage.count_ticks(num_ticks)
        self._stage.path.stay(num_ticks, scene=self._stage.scene, joints=self._joints)

    def _film(self, direction: Vector3, length: float) -> None:
        """Record the frames of a stretch in which nothing is touched."""
        stage = self._stage
        if not stage.path.is_filmed or length <= 0:
            return
        scene = stage.scene()
        joints = self._joints_at(*_moved(self._tip, direction, length))
        stage.path.move(joints, scene=lambda _: scene, speed=SWEEP_SPEED)
        stage.path.waypoints.pop()

    def _is_calm(self) -> bool:
        speed, turning = self._bodies.speeds()
        return speed < settling.SETTLED_SPEED and turning < settling.SETTLED_TURNING

    def _joints(self) -> np.ndarray:
        return self._joints_at(*self._tip)

    def _joints_at(self, x: float, y: float, tip_z: float) -> np.ndarray:
        return reachable_joints(x, y, tip_z, self._yaw_rad)

    def _pose(self) -> Pose:
        x, y, tip_z = self._tip
        return Pose.planar(x, y, self._yaw_rad, z=tools.blade_centre_z(tip_z))


def _direction(start: Vector3, end: Vector3, distance: float) -> Vector3:
    return ((end[0] - start[0]) / distance, (end[1] - start[1]) / distance, (end[2] - start[2]) / distance)


def _moved(point: Vector3, direction: Vector3, length: float) -> Vector3:
    return (
        point[0] + direction[0] * length,
        point[1] + direction[1] * length,
        point[2] + direction[2] * length,
    )


def _bow(start: np.ndarray, end: np.ndarray) -> list[Vector3]:
    """Points, some millimetres apart, that the arm's tip passes when it moves straight in joint space.

    Args:
        start: Joint angles, shape (6,), radians.
        end: The same; the tip's position there is the last point.
    """
    points = [
        ur5.forward(start + (end - start) * (k / _NUM_BOW_POINTS)).position
        for k in range(_NUM_BOW_POINTS + 1)
    ]
    way = [points[0]]
    for point in points:
        if math.dist(point, way[-1]) >= _BOW_STEP_M:
            way.append(point)
    return [*way[1:], points[-1]]
