"""Goals and constraints: conditions on the poses of a scene."""

import math
from dataclasses import dataclass

from openvima.scene.pose import Pose, angle_difference, rotate
from openvima.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class Tolerance:
    """Distance from a target that counts as reached; both comparisons are strict.

    Args:
        position_m: Planar distance in metres.
        yaw_rad: Angle in radians, or None if any heading is fine.
    """

    position_m: float
    yaw_rad: float | None = None

    def accepts(self, pose: Pose, target: Pose, symmetry_rad: float = 2 * math.pi) -> bool:
        """Whether `pose` matches `target`; headings `symmetry_rad` apart are equivalent."""
        if not pose.planar_distance(target) < self.position_m:
            return False
        if self.yaw_rad is None:
            return True
        return angle_difference(pose.yaw_rad, target.yaw_rad, symmetry_rad) < self.yaw_rad


@dataclass(frozen=True, slots=True)
class Zone:
    """A flat rectangle on the table.

    Args:
        x, y: Centre in metres.
        size_x, size_y: Full extents in metres along the world's x and y axes.
    """

    x: float
    y: float
    size_x: float
    size_y: float

    def contains(self, point: tuple[float, float, float]) -> bool:
        """Whether a point is strictly inside the rectangle and less than 0.3 m above the table."""
        px, py, pz = point
        return abs(px - self.x) < self.size_x / 2 and abs(py - self.y) < self.size_y / 2 and pz < 0.3

    def is_near(self, pose: Pose) -> bool:
        """Whether a small block at `pose` can have a point in the zone; cheaper than its points."""
        reach_x, reach_y = self.size_x / 2 + _BLOCK_REACH_M, self.size_y / 2 + _BLOCK_REACH_M
        return abs(pose.x - self.x) < reach_x and abs(pose.y - self.y) < reach_y


# The benchmark represents a small block by a grid of step 0.02 m that starts at the lower corner and misses
# the upper one: local coordinates −0.015 and +0.005 on each axis. Published results depend on that asymmetry.
_BLOCK_GRID = (-0.015, 0.005)
_BLOCK_REACH_M = 0.026  # of the farthest point from the block's centre
BLOCK_POINTS = tuple((x, y, z) for x in _BLOCK_GRID for y in _BLOCK_GRID for z in _BLOCK_GRID)


def block_points(pose: Pose) -> list[tuple[float, float, float]]:
    """The eight points that stand for a small block at `pose`, in the world, metres."""
    points = []
    for local in BLOCK_POINTS:
        dx, dy, dz = rotate(pose.quaternion, local)
        points.append((pose.x + dx, pose.y + dy, pose.z + dz))
    return points


@dataclass(frozen=True, slots=True)
class AtPose:
    """The object's link frame is at a target pose.

    Args:
        object_id: The object to move.
        target: Its target pose.
        tolerance: Tolerance of the pose.
        symmetry_rad: Angle of rotational symmetry of the object's shape.
        relative_to: Id of the object that the target is relative to (its base, or the object itself for a
            rotation in place); demonstrations record it. None: relative to the table.
    """

    object_id: int
    target: Pose
    tolerance: Tolerance
    symmetry_rad: float = 2 * math.pi
    relative_to: int | None = None

    def is_met(self, scene: Scene) -> bool:
        """Whether the object is at the target."""
        return self.tolerance.accepts(scene[self.object_id].pose, self.target, self.symmetry_rad)


@dataclass(frozen=True, slots=True)
class InZone:
    """All eight points of a small block are in a zone.

    Args:
        object_id: The block.
        zone: The target zone.
        relative_to: Id of the object that marks the zone, as for `AtPose`.
    """

    object_id: int
    zone: Zone
    relative_to: int | None = None

    def is_met(self, scene: Scene) -> bool:
        """Whether the block is in the zone."""
        return all(self.zone.contains(point) for point in block_points(scene[self.object_id].pose))


Goal = AtPose | InZone


@dataclass(frozen=True, slots=True)
class DistractorsApart:
    """No distractor is near a goal's target, and no goal's object near a distractor.

    Tested after every step, whether the goals are met or not: a distractor within a goal's
    `tolerance.position_m` of its target, or the goal's object matching the distractor's pose within the
    goal's whole tolerance, is a violation.

    Args:
        object_ids: The distractors.
        at_end: Test only once, in the step that fulfils the last of the goals.
        goals: Indices of the goals that count; None: all of the episode.
    """

    object_ids: tuple[int, ...]
    at_end: bool = False
    goals: tuple[int, ...] | None = None


@dataclass(frozen=True, slots=True)
class ZoneKeptClear:
    """No point of these blocks is in the zone; tested after every step."""

    object_ids: tuple[int, ...]
    zone: Zone


@dataclass(frozen=True, slots=True)
class NeverTouches:
    """No point of these blocks ever enters the zone; tested during motion, and permanent.

    Args:
        object_ids: The blocks.
        zone: The forbidden rectangle.
        name: Name of the zone in the reason of a failure, such as "line".
    """

    object_ids: tuple[int, ...]
    zone: Zone
    name: str

    def touching(self, scene: Scene) -> int | None:
        """Id of the first object that touches the zone now, or None."""
        for object_id in self.object_ids:
            pose = scene[object_id].pose
            if not self.zone.is_near(pose):
                continue
            if any(self.zone.contains(point) for point in block_points(pose)):
                return object_id
        return None


@dataclass(frozen=True, slots=True)
class InOrder:
    """None of these goals is fulfilled while an earlier goal of the episode is open; tested after every step.

    Args:
        goals: Indices of the later goals.
    """

    goals: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class EveryStepCounts:
    """Each step has to fulfil a goal; the first one that does not ends the episode."""


Constraint = DistractorsApart | ZoneKeptClear | NeverTouches | InOrder | EveryStepCounts
