"""Motion of the spatula and of the bodies that it pushes during one sweep.

Physics runs only while contacts change, and only for bodies that are or will be in contact: the spatula moves
freely up to the first body, and bodies flat against it are carried rigidly until the next contact.
"""

import math

import numpy as np

from openvima.catalog.geometry import Vector3
from openvima.scene import Pose
from openvima.scene.scene import rotate
from openvima.sim import ur5
from openvima.sim.bodies import MAX_SPEED, distance_to_contact
from openvima.sim.model import TICK_S
from openvima.sim.primitive_state import (
    MONITOR_TICKS,
    SETTLE_LIMIT_TICKS,
    SETTLED_SPEED,
    SETTLED_TURNING,
    STRIDE_TICKS,
    SWEEP_SPEED,
    PrimitiveState,
    Settling,
    reachable_joints,
)

SWEEP_M_S = 0.12  # 0.5 mm a tick; VIMA-Bench takes 350–430 ticks for 0.2 m
# Pushed bodies jitter, but hardly shift against the spatula. Carrying them without physics saves three of
# four ticks and changes final positions as much as a 0.1 % faster spatula (1.5 mm in the median, at most 12).
CARRIED_SHIFT_M = 6e-4  # bodies that shift against the spatula by less than this, and rotate by less …
CARRIED_ROTATION_RAD = 0.02  # … than this …
_CARRIED_STRIDES = 4  # … in so many strides of physics are carried
_MAX_CARRY_M = 0.2  # then physics runs again, to catch slow slipping
_MIN_CARRY_M = 0.003  # the contact query costs as much as a few ticks
_STRIDE_M = MAX_SPEED * STRIDE_TICKS * TICK_S  # no body moves farther in a stride …
_SLIDE_M = 0.045  # … or slides farther at friction 0.3
_LOW_TIP_Z_M = 0.035  # the spatula's edge is then just above the blocks
_PATH_STEP_M = 0.004  # length of the straight segments of a joint-space path
_NUM_PATH_POINTS = 400  # samples of a joint-space path


class Spatula:
    """The spatula during one sweep.

    Args:
        state: Bodies and arm.
        yaw_rad: Heading of the sweep.
        in_joint_space: Move straight in joint space, as VIMA-Bench's arm does: the spatula deviates by some
            centimetres in a long sweep. Else straight down, along and up.
        awake: Bodies are moving already.
    """

    def __init__(
        self, state: PrimitiveState, yaw_rad: float, *, in_joint_space: bool = False, awake: bool = False
    ) -> None:
        self._state = state
        self._bodies = state.bodies
        self._yaw_rad = yaw_rad
        self._in_joint_space = in_joint_space
        self._tip: Vector3 = (0.0, 0.0, ur5.SWEEP_HOVER_TIP_Z_M)
        self._recent: list[tuple[np.ndarray, Vector3]] = []  # coordinates and tip before the last strides
        self._bodies.sleeping = set(() if awake else state.bodies.rigid)
        self._pushed = tuple(geom for index in state.bodies.rigid for geom in state.bodies.geoms[index])

    def lower(self, x: float, y: float) -> None:
        """Lower the spatula at a point and displace bodies there."""
        hover = self._joints_at(x, y, ur5.SWEEP_HOVER_TIP_Z_M)
        down = self._joints_at(x, y, ur5.SWEEP_TIP_Z_M)
        self._state.move(hover)
        self._state.move(down)
        way = [point for point in self._bent_path(hover, down) if point[2] < _LOW_TIP_Z_M]
        self._tip, *rest = [*way, (x, y, ur5.SWEEP_TIP_Z_M)]
        in_the_way = [index for index in self._bodies.rigid if self._displace(index)]
        if in_the_way:
            self._wait()
        for point in rest:
            self._push_to(point)

    def push(self, x: float, y: float) -> None:
        """Move the lowered spatula to a point."""
        target = self._joints_at(x, y, ur5.SWEEP_TIP_Z_M)
        for point in (*self._bent_path(self._joints(), target), (x, y, ur5.SWEEP_TIP_Z_M)):
            self._push_to(point)
        self._state.waypoints.append(target)

    def engage(self, x: float, y: float) -> None:
        """Press the spatula to the table where it is, displacing bodies there."""
        self._tip = (x, y, ur5.SWEEP_TIP_Z_M)
        for index in self._bodies.rigid:
            self._displace(index)

    def slide(self, x: float, y: float, yaw_rad: float, num_ticks: int) -> None:
        """Move the pressed spatula with physics, to a pose that it reaches after some ticks."""
        time_s = num_ticks * TICK_S
        dx, dy, turn = x - self._tip[0], y - self._tip[1], yaw_rad - self._yaw_rad
        for done in range(0, num_ticks, STRIDE_TICKS):
            ticks = min(STRIDE_TICKS, num_ticks - done)
            self._run(ticks, (dx / time_s, dy / time_s, 0.0), turn / time_s)
            share = ticks / num_ticks
            self._tip = _move(self._tip, (dx, dy, 0.0), share)
            self._yaw_rad += turn * share
        self._tip, self._yaw_rad = (x, y, self._tip[2]), yaw_rad

    def release(self) -> Settling:
        """Take the spatula off the table; return the settling of the bodies that it moved."""
        self._bodies.park_spatula()
        self._wake(_SLIDE_M)
        return Settling(self._bodies, MAX_SPEED)

    def lift(self) -> None:
        """Lift the spatula and let everything settle."""
        state = self._state
        hover = self._joints_at(self._tip[0], self._tip[1], ur5.SWEEP_HOVER_TIP_Z_M)
        for point in self._bent_path(self._joints(), hover):
            if point[2] > _LOW_TIP_Z_M:
                break
            self._push_to(point)
        self._bodies.park_spatula()
        if state.num_ticks:
            self._wake(_SLIDE_M)
            state.settle(max_speed=MAX_SPEED)
        state.move(hover, scene=lambda _: state.scene())

    def _displace(self, index: int) -> bool:
        """Shift a body under the spatula to the nearest side; return whether there was one.

        Squeezed between spatula and floor, the physics would fling it away; VIMA-Bench nudges it.
        """
        pose, spatula = self._bodies.pose(index), self._pose()
        reach = self._bodies.shapes[index].radius_m + ur5.SPATULA_HALF_SIZE_M[1]
        if pose.planar_distance(spatula) > math.sqrt(2) * reach:
            return False
        corners = spatula.inverse().transform(pose.transform(self._bodies.shapes[index].points[:, :3]))
        half = np.array(ur5.SPATULA_HALF_SIZE_M)
        low, high = corners.min(axis=0) - half, corners.max(axis=0) + half  # body grown by the spatula
        if (low[:2] >= 0).any() or (high[:2] <= 0).any():
            return False
        shifts = [(-low[0], 0.0), (-high[0], 0.0), (0.0, -low[1]), (0.0, -high[1])]
        along, across = min(shifts, key=lambda shift: abs(shift[0]) + abs(shift[1]))
        dx, dy, _ = rotate(spatula.quaternion, (along, across, 0.0))
        self._bodies.place(index, pose.moved(dx, dy))
        return True

    def _wait(self) -> None:
        """Run physics with the spatula at rest until everything is at rest."""
        for _ in range(SETTLE_LIMIT_TICKS // STRIDE_TICKS):
            self._run(STRIDE_TICKS, (0.0, 0.0, 0.0))
            if self._is_calm():
                return

    def _push_to(self, target: Vector3) -> None:
        """Move the tip in a straight line to a point and push what is in the way.

        Three gaits, by what the bodies do: none moves, so the spatula goes on to the first contact without
        physics; all that move ride along with it, so they are shifted rigidly to the next contact; else
        physics. Short of the target, a stride of physics follows in any case: contacts have changed.
        """
        while (left := math.dist(target, self._tip)) > 1e-9:
            x, y, z = ((end - start) / left for start, end in zip(self._tip, target, strict=True))
            direction = (x, y, z)
            if self._is_calm():
                left = self._move_freely(direction, left)
            elif left > _MIN_CARRY_M and (carried := self._carried_bodies()) is not None:
                left -= self._carry(carried, direction, min(left, _MAX_CARRY_M))
            ticks = min(STRIDE_TICKS, max(1, math.ceil(left / (SWEEP_M_S * TICK_S) - 1e-9)))
            way = min(left, ticks * SWEEP_M_S * TICK_S)
            if way > 0:
                self._push_with_physics(direction, way, ticks)
        self._tip = target

    def _move_freely(self, direction: Vector3, length: float) -> float:
        """Move without physics to the first contact; return the remaining distance."""
        self._recent.clear()
        self._bodies.stop()
        self._bodies.place_spatula(self._pose())
        self._bodies.refresh()
        free = distance_to_contact(
            self._bodies, (self._bodies.spatula_geom,), self._pushed, direction=direction, length_m=length
        )
        way = min(free, length)
        self._record_frames(direction, way)
        self._tip = _move(self._tip, direction, way)
        return length - way

    def _carried_bodies(self) -> tuple[int, ...] | None:
        """The carried bodies; None while any body neither moves with the spatula nor rests.

        Positions are compared over the last strides, not velocities: pushed bodies jitter without going
        anywhere. Rows of `change`, shape (free bodies, 7), are position and quaternion.
        """
        if len(self._recent) < _CARRIED_STRIDES:
            return None
        before, tip = self._recent[-_CARRIED_STRIDES]
        change = self._bodies.coordinates() - before
        if 2 * np.abs(change[:, 3:]).max() >= CARRIED_ROTATION_RAD:
            return None
        stands = np.abs(change[:, :3]).max(axis=1) < CARRIED_SHIFT_M
        rides = np.abs(change[:, :3] - np.subtract(self._tip, tip)).max(axis=1) < CARRIED_SHIFT_M
        if not (stands | rides).all():
            return None
        return tuple(
            index for index, riding in zip(self._bodies.rigid, rides.tolist(), strict=True) if riding
        )

    def _carry(self, carried: tuple[int, ...], direction: Vector3, length: float) -> float:
        """Carry bodies without physics to the next contact; return the distance."""
        self._recent.clear()
        way = self._distance_to_next(carried, direction, length)
        if way < _MIN_CARRY_M:
            return 0.0
        self._state.notify()
        left, longest = way, MONITOR_TICKS * SWEEP_M_S * TICK_S
        while left > 0:
            piece = min(left, longest)
            self._bodies.shift(carried, _move((0.0, 0.0, 0.0), direction, piece))
            self._tip = _move(self._tip, direction, piece)
            left -= piece
            self._state.notify()
            num_ticks = max(1, round(piece / (SWEEP_M_S * TICK_S)))
            self._state.stay(num_ticks, self._joints)
        return way

    def _distance_to_next(self, carried: tuple[int, ...], direction: Vector3, length: float) -> float:
        """How far spatula and carried bodies can move before the next contact, at most `length`."""
        bodies = self._bodies
        bodies.place_spatula(self._pose())
        bodies.refresh()
        others = [index for index in range(len(bodies.shapes)) if index not in carried]
        fixed = [geom for index in others if index not in bodies.rigid for geom in bodies.geoms[index]]
        free = [geom for index in others if index in bodies.rigid for geom in bodies.geoms[index]]
        carried_geoms = [geom for index in carried for geom in bodies.geoms[index]]
        ways = (
            distance_to_contact(bodies, (bodies.spatula_geom,), free, direction=direction, length_m=length),
            distance_to_contact(bodies, carried_geoms, [*free, *fixed], direction=direction, length_m=length),
        )
        return min(*ways, length)

    def _push_with_physics(self, direction: Vector3, length: float, num_ticks: int) -> None:
        """Move by a length with physics, at constant speed."""
        self._recent = [*self._recent[1 - _CARRIED_STRIDES :], (self._bodies.coordinates(), self._tip)]
        speed = length / (num_ticks * TICK_S)
        self._run(num_ticks, _move((0.0, 0.0, 0.0), direction, speed))
        self._tip = _move(self._tip, direction, length)

    def _run(self, num_ticks: int, velocity: Vector3, turning: float = 0.0) -> None:
        self._wake(_STRIDE_M)
        self._bodies.tick_with_spatula(self._pose(), velocity, num_ticks, turning=turning)
        self._state.count_ticks(num_ticks)
        self._state.stay(num_ticks, self._joints)

    def _wake(self, near_m: float) -> None:
        """Wake the sleeping bodies near the spatula, those near a woken body, and so on."""
        bodies = self._bodies
        if not bodies.sleeping:
            return
        circles = {
            index: (x, y, bodies.shapes[index].radius_m)
            for index, (x, y) in zip(bodies.rigid, bodies.coordinates()[:, :2].tolist(), strict=True)
        }
        awake = [circles[index] for index in bodies.rigid if index not in bodies.sleeping]
        awake.append((*self._tip[:2], ur5.SPATULA_HALF_SIZE_M[1]))
        while awake:
            x, y, reach = awake.pop()
            for index in tuple(bodies.sleeping):
                other_x, other_y, radius = circles[index]
                if math.hypot(other_x - x, other_y - y) < reach + radius + near_m:
                    bodies.sleeping.remove(index)
                    awake.append(circles[index])

    def _record_frames(self, direction: Vector3, length: float) -> None:
        """Record the frames of a motion without contact."""
        state = self._state
        if state.record is None or length <= 0:
            return
        joints = self._joints_at(*_move(self._tip, direction, length))
        state.move(joints, scene=lambda _: state.scene(), speed=SWEEP_SPEED)
        state.waypoints.pop()

    def _is_calm(self) -> bool:
        speed, turning = self._bodies.speeds()
        return speed < SETTLED_SPEED and turning < SETTLED_TURNING

    def _bent_path(self, start: np.ndarray, end: np.ndarray) -> list[Vector3]:
        """Points, some millimetres apart, of a path that is straight in joint space; none without such paths.

        Args:
            start: Joint angles, shape (6,), radians.
            end: Joint angles at the last point.
        """
        if not self._in_joint_space:
            return []
        points = [
            ur5.forward(start + (end - start) * (k / _NUM_PATH_POINTS)).position
            for k in range(_NUM_PATH_POINTS + 1)
        ]
        way = [points[0]]
        for point in points:
            if math.dist(point, way[-1]) >= _PATH_STEP_M:
                way.append(point)
        return [*way[1:], points[-1]]

    def _joints(self) -> np.ndarray:
        return self._joints_at(*self._tip)

    def _joints_at(self, x: float, y: float, tip_z: float) -> np.ndarray:
        return reachable_joints(x, y, tip_z, self._yaw_rad)

    def _pose(self) -> Pose:
        x, y, tip_z = self._tip
        centre_z = tip_z - ur5.SPATULA_BELOW_TIP_M + ur5.SPATULA_HALF_SIZE_M[2]
        return Pose.planar(x, y, self._yaw_rad, z=centre_z)


def _move(point: Vector3, direction: Vector3, length: float) -> Vector3:
    x, y, z = (start + part * length for start, part in zip(point, direction, strict=True))
    return (x, y, z)
