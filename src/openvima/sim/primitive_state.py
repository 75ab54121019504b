"""State of one primitive: bodies, settling, and the path of the arm with frames for a video."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from openvima.scene import Placement, Pose, Scene
from openvima.sim.bodies import Bodies, body_gap
from openvima.sim.model import FLOOR_Z_M, TICK_S
from openvima.sim.ur5 import REACH_RESERVE_M, highest_tip_z, inverse

SETTLED_SPEED = 5e-3  # m/s, as in VIMA-Bench
SETTLED_TURNING = 0.05  # rad/s: a body that topples rotates before its centre moves
SETTLE_LIMIT_TICKS = 1000
MONITOR_TICKS = 25  # interval of constraint checks
STRIDE_TICKS = 5  # interval of speed checks; divides MONITOR_TICKS
_QUIET_STRIDES = 2  # consecutive, so that a body that reverses its motion does not count as settled


@dataclass(slots=True, eq=False)
class Settling:
    """Physics until every free body has been slow for 10 ticks, or the limit is reached.

    Args:
        bodies: The bodies.
        max_speed: Bound of the horizontal speed in m/s, for bodies that overlap at the start.
        num_ticks: Ticks so far.
    """

    bodies: Bodies
    max_speed: float | None = None
    num_ticks: int = 0
    _quiet: int = 0  # strides in a row in which all bodies were slow

    @property
    def is_over(self) -> bool:
        """Whether every body has been slow for long enough, or the limit is reached."""
        return self._quiet >= _QUIET_STRIDES or self.num_ticks >= SETTLE_LIMIT_TICKS

    def run(self, num_ticks: int = STRIDE_TICKS) -> None:
        """Run one stride; where it is the last one, stop all bodies."""
        before = self.bodies.coordinates()
        self.bodies.tick(num_ticks)
        if self.max_speed is not None:
            self.bodies.limit_speed(self.max_speed)
        self.num_ticks += num_ticks
        speed, turning = self.bodies.mean_speeds(before, num_ticks * TICK_S)
        is_slow = speed < SETTLED_SPEED and turning < SETTLED_TURNING
        self._quiet = self._quiet + 1 if is_slow else 0
        if self.is_over:
            self.bodies.stop()
            self.bodies.refresh()


FRAMES_PER_SECOND = 30  # of simulated time, in a video
FRAME_S = 1 / FRAMES_PER_SECOND
FREE_SPEED = 2.4  # rad/s, Euclidean norm over the joints, as in VIMA-Bench
SWEEP_SPEED = 0.48

Monitor = Callable[[Scene], None]
RecordFrame = Callable[[Scene, np.ndarray], None]


def reachable_joints(x: float, y: float, z: float, yaw_rad: float) -> np.ndarray:
    """Joint angles, shape (6,), for a tip above (x, y), at height `z` or as high as the arm reaches.

    Far from the base the arm does not reach its hover height with the tool vertical.

    Raises:
        ActionError: The arm does not reach (x, y) at any height.
    """
    return inverse(x, y, min(z, highest_tip_z(x, y) - REACH_RESERVE_M), yaw_rad)


RESTING_GAP_M = 5e-4  # bodies nearer than this may support each other
LEVEL_RAD = 0.03  # the pan rests tilted by 0.01
STILL_M = 5e-5  # a body that moved by less than this, and rotated by less than …
STILL_RAD = 5e-4  # … this, keeps its pose, so that nothing creeps over many steps


@dataclass(slots=True, eq=False)
class PrimitiveState:
    """Bodies and arm during one primitive, with the callbacks that follow their motion.

    Frames are computed only with a recorder.

    Args:
        start: The scene at the start.
        bodies: Its bodies.
        waypoints: Joint angles of the arm so far, shape (6,), float64, radians.
        monitor: Called with the scene at least every 25 ticks of physics, or None.
        record: Called with scene and joints for every video frame, or None.
        num_ticks: Ticks of physics so far.
    """

    start: Scene
    bodies: Bodies
    waypoints: list[np.ndarray]
    monitor: Monitor | None
    record: RecordFrame | None = None
    num_ticks: int = 0
    _unmonitored_ticks: int = 0
    _since_frame_s: float = 0.0
    _stored: list[Scene] = field(default_factory=list)

    def placement(self, index: int) -> Placement:
        """A placement at the start."""
        return self.start.placements[index]

    def scene(self, held: tuple[int, Pose] | None = None) -> Scene:
        """The current scene; `held` is the index and pose of a body out of the physics."""
        poses = {self.placement(i).id: self.bodies.pose(i) for i in self.bodies.rigid}
        if held is not None:
            poses[self.placement(held[0]).id] = held[1]
        return self.start.with_poses(poses)

    def count_ticks(self, num_ticks: int, held: tuple[int, Pose] | None = None) -> None:
        """Count up to `STRIDE_TICKS` physics ticks, and call the monitor when it is due."""
        self.num_ticks += num_ticks
        self._unmonitored_ticks += num_ticks
        is_time = self._unmonitored_ticks + STRIDE_TICKS > MONITOR_TICKS
        if is_time and self.monitor is not None:
            self._unmonitored_ticks = 0
            self.monitor(self.scene(held))

    def notify(self) -> None:
        """Call the monitor now: bodies move without physics."""
        if self.monitor is not None:
            self._unmonitored_ticks = 0
            self.monitor(self.scene())

    def settle(self, held: tuple[int, Pose] | None = None, *, max_speed: float | None = None) -> None:
        """Run physics until everything is at rest; the arm's next move happens meanwhile."""
        settling = Settling(self.bodies, max_speed)
        while not settling.is_over:
            settling.run()
            self.count_ticks(STRIDE_TICKS, held)
            self._stored += [self.scene(held) for _ in self._frame_times(STRIDE_TICKS * TICK_S)]

    def move(
        self,
        joints: np.ndarray,
        *,
        scene: Callable[[np.ndarray], Scene] | None = None,
        speed: float = FREE_SPEED,
    ) -> None:
        """Move the arm in a straight line in joint space.

        Args:
            joints: Target joint angles, shape (6,), radians.
            scene: Returns the scene for the joints of a frame; stored scenes come first. None: that at the
                start.
            speed: In rad/s, Euclidean norm over the joints.
        """
        start = self.waypoints[-1]
        self.waypoints.append(joints)
        if self.record is None:
            return
        duration_s = max(math.dist(joints, start) / speed, 1e-9)
        stored, self._stored = self._stored, []
        now = start
        for time_s in self._frame_times(duration_s):
            now = start + (joints - start) * (time_s / duration_s)
            self.record(stored.pop(0) if stored else scene(now) if scene else self.start, now)
        for late in stored:
            self.record(late, joints)

    def stay(self, num_ticks: int, joints: Callable[[], np.ndarray]) -> None:
        """Record the frames of some physics ticks, with the arm at `joints()`."""
        for _ in self._frame_times(num_ticks * TICK_S):
            if self.record is not None:
                self.record(self.scene(), joints())

    def _frame_times(self, duration_s: float) -> Iterator[float]:
        """Times within the coming `duration_s` seconds at which a frame is due."""
        if self.record is None:
            return
        due_s = FRAME_S - self._since_frame_s
        count = max(0, math.floor((duration_s - due_s) / FRAME_S + 1e-9) + 1)
        self._since_frame_s += duration_s - count * FRAME_S
        for index in range(count):
            yield due_s + index * FRAME_S

    def finish(self) -> Scene:
        """Reset bodies that hardly moved; monitor and return the final scene."""
        poses = {}
        for index in self.bodies.rigid:
            before, after = self.placement(index).pose, self.bodies.pose(index)
            if _is_still(before, after):
                self.bodies.place(index, before)
            else:
                poses[self.placement(index).id] = after
        self.bodies.refresh()
        final = self.start.with_poses(poses)
        if self.monitor is not None:
            self.monitor(final)
        return final


def _is_still(before: Pose, after: Pose) -> bool:
    if math.dist(before.position, after.position) > STILL_M:
        return False
    cosine = abs(sum(a * b for a, b in zip(before.quaternion, after.quaternion, strict=True)))
    return cosine > math.cos(STILL_RAD / 2)


def is_level(pose: Pose) -> bool:
    """Whether a body lies flat, either way up."""
    x, y, _, _ = pose.quaternion
    return abs(1 - 2 * (x * x + y * y)) > math.cos(LEVEL_RAD)


def is_at_rest(bodies: Bodies) -> bool:
    """Whether every free body lies flat on the floor and overlaps no other."""
    for index in bodies.rigid:
        pose = bodies.pose(index)
        if not is_level(pose):
            return False
        if abs(pose.z + bodies.lowest_z(index, pose.quaternion) - FLOOR_Z_M) > RESTING_GAP_M:
            return False
    return not any(
        body_gap(bodies, index, other) < -RESTING_GAP_M
        for index in bodies.rigid
        for other in range(len(bodies.shapes))
        if other < index or other not in bodies.rigid
    )
