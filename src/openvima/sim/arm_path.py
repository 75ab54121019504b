"""Path of the arm during one primitive: waypoints, and frames for a video."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from openvima.scene import Scene
from openvima.sim.end_effectors import REACH_RESERVE_M
from openvima.sim.model import TICK_S
from openvima.sim.ur5 import highest_tip_z, inverse

FREE_SPEED = 2.4  # rad/s, Euclidean norm over the joints, as in VIMA-Bench
SWEEP_SPEED = 0.48

RecordFrame = Callable[[Scene, np.ndarray], None]


def reachable_joints(x: float, y: float, z: float, yaw_rad: float) -> np.ndarray:
    """Joint angles, shape (6,), for a tip above (x, y), at height `z` or as high as the arm reaches.

    Far from the base the arm does not reach its hover height with the tool vertical.

    Raises:
        ReachError: The arm does not reach (x, y) at any height.
    """
    return inverse(x, y, min(z, highest_tip_z(x, y) - REACH_RESERVE_M), yaw_rad)


class ArmPath:
    """The path of the arm during one primitive.

    Frames are computed only with a recorder.

    Args:
        joints: Joint angles at the start, shape (6,), radians.
        record: Called with scene and joints for every video frame, or None.
        frames_per_second: Frame rate of the video.
    """

    def __init__(self, joints: np.ndarray, record: RecordFrame | None, frames_per_second: float) -> None:
        self.waypoints = [np.array(joints, dtype=np.float64)]
        self._record = record
        self._frame_s = 1 / frames_per_second
        self._since_frame_s = 0.0
        self._stored: list[Scene] = []

    @property
    def joints(self) -> np.ndarray:
        """Current joint angles, shape (6,), radians."""
        return self.waypoints[-1]

    @property
    def is_recording(self) -> bool:
        """Whether frames are recorded."""
        return self._record is not None

    def move(
        self, joints: np.ndarray, *, scene: Callable[[np.ndarray], Scene], speed: float = FREE_SPEED
    ) -> None:
        """Move in a straight line in joint space.

        Args:
            joints: Target joint angles, shape (6,), radians.
            scene: Returns the scene for the joints of a frame; stored scenes come first.
            speed: In rad/s, Euclidean norm over the joints.
        """
        start = self.joints
        self.waypoints.append(joints)
        if self._record is None:
            return
        duration_s = max(math.dist(joints, start) / speed, 1e-9)
        stored, self._stored = self._stored, []
        now = start
        for time_s in self._frame_times(duration_s):
            now = start + (joints - start) * (time_s / duration_s)
            self._record(stored.pop(0) if stored else scene(now), now)
        for late in stored:
            self._record(late, joints)

    def stay(self, num_ticks: int, *, scene: Callable[[], Scene], joints: Callable[[], np.ndarray]) -> None:
        """Record the frames of some physics ticks, with the arm at `joints()`."""
        for _ in self._frame_times(num_ticks * TICK_S):
            if self._record is not None:
                self._record(scene(), joints())

    def store(self, num_ticks: int, *, scene: Callable[[], Scene]) -> None:
        """Store the frames of some physics ticks for the arm's next move, which happens meanwhile."""
        for _ in self._frame_times(num_ticks * TICK_S):
            self._stored.append(scene())

    def array(self) -> np.ndarray:
        """Waypoints, shape (W, 6), float32, radians."""
        return np.array(self.waypoints, dtype=np.float32)

    def _frame_times(self, duration_s: float) -> Iterator[float]:
        """Times within the coming `duration_s` seconds at which a frame is due."""
        if self._record is None:
            return
        due_s = self._frame_s - self._since_frame_s
        count = max(0, math.floor((duration_s - due_s) / self._frame_s + 1e-9) + 1)
        self._since_frame_s += duration_s - count * self._frame_s
        for index in range(count):
            yield due_s + index * self._frame_s
