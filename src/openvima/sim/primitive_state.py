"""State of one primitive: bodies, arm and monitor."""

import math
from collections.abc import Callable, Collection

from openvima.scene import Placement, Pose, Scene
from openvima.sim import settling
from openvima.sim.arm_path import ArmPath
from openvima.sim.bodies import Bodies
from openvima.sim.contacts import body_gap
from openvima.sim.model import FLOOR_Z_M

RESTING_GAP_M = 5e-4  # bodies nearer than this may support each other
LEVEL_RAD = 0.03  # the pan rests tilted by 0.01
STILL_M = 5e-5  # a body that moved by less than this, and rotated by less than …
STILL_RAD = 5e-4  # … this, keeps its pose, so that nothing creeps over many steps


class PrimitiveState:
    """Bodies, arm and monitor during one primitive.

    Args:
        scene: The scene at the start.
        bodies: Its bodies.
        path: Path of the arm.
        monitor: Called with the scene at least every 25 ticks of physics, or None.
    """

    def __init__(
        self, scene: Scene, bodies: Bodies, path: ArmPath, monitor: Callable[[Scene], None] | None
    ) -> None:
        self.start = scene
        self.bodies = bodies
        self.path = path
        self.num_ticks = 0
        self.completed = True
        self._monitor = monitor
        self._unmonitored_ticks = 0

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
        is_time = self._unmonitored_ticks + settling.STRIDE_TICKS > settling.MONITOR_TICKS
        if is_time and self._monitor is not None:
            self._unmonitored_ticks = 0
            self._monitor(self.scene(held))

    def notify(self) -> None:
        """Call the monitor now: bodies move without physics."""
        if self._monitor is not None:
            self._unmonitored_ticks = 0
            self._monitor(self.scene())

    def settle(
        self,
        held: tuple[int, Pose] | None = None,
        *,
        max_speed: float | None = None,
        sleeping: Collection[int] = (),
    ) -> None:
        """Run physics until everything is at rest; the arm's next move happens meanwhile."""

        def each(num_ticks: int) -> None:
            self.count_ticks(num_ticks, held)
            self.path.store(num_ticks, scene=lambda: self.scene(held))

        held_index = held[0] if held else None
        _, completed = settling.settle(
            self.bodies, apart_from=held_index, max_speed=max_speed, sleeping=sleeping, each=each
        )
        self.completed = self.completed and completed

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
        if self._monitor is not None:
            self._monitor(final)
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
