"""Geometry of pushes of small blocks: footprints, the areas that they cover, and collisions in a scene.

Of 480 simulated pushes of 0.05 to 0.3 m, the middle of the spatula up to 15 mm beside that of the block, no
point of a block strayed more than 24 mm to the side, and no block came to rest more than 9 mm beyond its end.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from openvima.errors import OracleError
from openvima.scene import (
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    InZone,
    NeverTouches,
    Point,
    Pose,
    Problem,
    Scene,
    Zone,
)
from openvima.scene.goal import object_of


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A rectangle on the table, rotated by `yaw_rad`.

    Args:
        x, y: Centre in metres.
        yaw_rad: Direction of its first axis.
        half_x, half_y: Half extents along its own axes in metres.
    """

    x: float
    y: float
    yaw_rad: float
    half_x: float
    half_y: float

    @staticmethod
    def of_box(pose: Pose, size_x: float, size_y: float) -> "Rectangle":
        """Footprint of a flat box with its link frame in the centre."""
        return Rectangle(pose.x, pose.y, pose.yaw_rad, size_x / 2, size_y / 2)

    @staticmethod
    def of_zone(zone: Zone) -> "Rectangle":
        """The rectangle of a zone."""
        return Rectangle(zone.x, zone.y, 0.0, zone.size_x / 2, zone.size_y / 2)

    def comes_near(self, other: "Rectangle", margin_m: float = 0.0) -> bool:
        """Whether no axis of either rectangle separates them by `margin_m`.

        Between corners, a gap slightly wider than the margin may still count as near.
        """
        return self.meets_box_around(other, margin_m) and other.meets_box_around(self, margin_m)

    def meets_box_around(self, other: "Rectangle", margin_m: float = 0.0) -> bool:
        """Whether this rectangle is near the other one's bounding box along its own axes."""
        dx, dy = other.x - self.x, other.y - self.y
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        angle = other.yaw_rad - self.yaw_rad
        other_cos, other_sin = abs(math.cos(angle)), abs(math.sin(angle))
        reach_x = self.half_x + other.half_x * other_cos + other.half_y * other_sin + margin_m
        reach_y = self.half_y + other.half_x * other_sin + other.half_y * other_cos + margin_m
        return abs(dx * cos + dy * sin) < reach_x and abs(dy * cos - dx * sin) < reach_y

    def half_width(self, direction_rad: float) -> float:
        """Half of the rectangle's extent along a direction, in metres."""
        angle = direction_rad - self.yaw_rad
        return self.half_x * abs(math.cos(angle)) + self.half_y * abs(math.sin(angle))


STANDOFF_M = 0.006  # distance behind a block's centre where a sweep starts: clears all corners
SHORTFALL_M = 0.0325  # distance of the pushed block's centre from a sweep's end
BLOCK_HALF_M, BLOCK_REACH_M = 0.015, 0.0212  # from a block's centre to its face and to its corner
OVERRUN_M = 0.009  # how far a block may slide

_ASIDE_M = 0.015  # lateral offset of the spatula from a block's centre

_SPATULA_OFFSET_M = 0.02  # distance behind the start of a sweep where the spatula is lowered
_SPATULA_HALF_THICKNESS_M = 0.0025
_SPATULA_HALF_WIDTH_M = 0.025
_SPATULA_GAP_M = 0.002  # clearance on either side of the spatula
_DRIFT_M = 0.005  # lateral shift of a block that rotates


@dataclass(frozen=True, slots=True)
class Sweep:
    """One sweep.

    Args:
        goal: The goal whose block is pushed.
        start: pose0, x and y in metres.
        end: pose1.
    """

    goal: InZone
    start: Point
    end: Point


@dataclass(frozen=True, slots=True)
class Push:
    """A block's centre pushed in a straight line.

    Args:
        start, end: x and y in metres.
        ux, uy: Unit vector of the push.
        length_m: Its length.
        aside_m: Offset of the spatula's centre to the left of the line.
    """

    start: Point
    end: Point
    ux: float
    uy: float
    length_m: float
    aside_m: float = 0.0

    @staticmethod
    def between(start: Point, end: Point) -> "Push":
        """Return the push between two points; one of zero length points towards the robot."""
        dx, dy = end[0] - start[0], end[1] - start[1]
        length = math.hypot(dx, dy)
        ux, uy = (dx / length, dy / length) if length > 0 else (-1.0, 0.0)
        return Push(start, end, ux, uy, length)

    @property
    def yaw_rad(self) -> float:
        """Direction of the push."""
        return math.atan2(self.uy, self.ux)

    def variants(self) -> Iterator["Push"]:
        """Variants with the spatula centred, to the left and to the right, within the bounds of actions."""
        for aside_m in (0.0, _ASIDE_M, -_ASIDE_M):
            push = replace(self, aside_m=aside_m)
            if is_inside(push.behind(), -STANDOFF_M) and is_inside(push._last(), 0.0):
                yield push

    def sweep(self, goal: InZone) -> Sweep:
        """Return the sweep that performs this push of the goal's block."""
        return Sweep(goal, self.behind(), self._last())

    def spatula_at_start(self) -> Rectangle:
        """Footprint of the spatula when it is lowered."""
        x, y = self._point(-STANDOFF_M - _SPATULA_OFFSET_M)
        return Rectangle(
            x, y, self.yaw_rad, _SPATULA_HALF_THICKNESS_M, _SPATULA_HALF_WIDTH_M + _SPATULA_GAP_M
        )

    def spatula_area(self) -> Rectangle:
        """Area that the spatula covers."""
        behind = STANDOFF_M + _SPATULA_OFFSET_M + _SPATULA_HALF_THICKNESS_M
        half_width = _SPATULA_HALF_WIDTH_M + _SPATULA_GAP_M
        return self._strip(behind, -BLOCK_HALF_M, half_width=half_width, aside_m=self.aside_m)

    def block_area(self) -> Rectangle:
        """Area that the block covers."""
        return self._strip(BLOCK_REACH_M, BLOCK_REACH_M + OVERRUN_M, half_width=BLOCK_REACH_M + _DRIFT_M)

    def swept_areas(self) -> tuple[Rectangle, Rectangle]:
        """Areas of spatula and block."""
        return self.spatula_area(), self.block_area()

    def behind(self) -> Point:
        """Return where a sweep starts: behind the block, clear of its corners."""
        return self._point(-STANDOFF_M)

    def _last(self) -> Point:
        return self._point(self.length_m + SHORTFALL_M)

    def _point(self, along_m: float) -> Point:
        """Point on the spatula's line, measured from the block's start."""
        x, y = self.start
        return x + along_m * self.ux - self.aside_m * self.uy, y + along_m * self.uy + self.aside_m * self.ux

    def _strip(self, behind: float, ahead: float, *, half_width: float, aside_m: float = 0.0) -> Rectangle:
        """Rectangle from `behind` the start to `ahead` of the end."""
        half_length = (self.length_m + ahead + behind) / 2
        middle = half_length - behind
        x = self.start[0] + middle * self.ux - aside_m * self.uy
        y = self.start[1] + middle * self.uy + aside_m * self.ux
        return Rectangle(x, y, self.yaw_rad, half_length, half_width)


def is_inside(point: Point, edge_m: float) -> bool:
    """Whether a point is in the workspace, shrunk by `edge_m` on every side."""
    return all(
        low + edge_m <= value <= high - edge_m
        for value, low, high in zip(point, WORKSPACE_LOW, WORKSPACE_HIGH, strict=True)
    )


_END_STEP_M = 0.015
_COLUMN_STEP_M = 0.05  # room for two blocks pushed along the same line
_END_EDGE_M = 0.03  # distance of ends from the zone's edge


@dataclass(frozen=True, slots=True)
class View:
    """Blocks and lines of a scene.

    Args:
        goals: The open goals, those with the block nearest to its zone first.
        footprints: Footprints of all blocks, by id.
        met_ids: Blocks of goals that are met.
        lines: Forbidden zones of the goals' blocks.
        overlap_m: Allowed overlap of a push with blocks swept already, in metres. Their goals stay met, and
            the spatula stops too early to push them onto a line.
    """

    goals: tuple[InZone, ...]
    footprints: dict[int, Rectangle]
    met_ids: frozenset[int]
    lines: tuple[Zone, ...]
    overlap_m: float = 0.0

    @staticmethod
    def build(goals: Sequence[InZone], scene: Scene, problem: Problem) -> "View":
        """Build the view of a scene with these open goals.

        Raises:
            OracleError: A goal's block is fixed to the table.
        """
        if fixed := [goal.object_id for goal in goals if scene[goal.object_id].fixed]:
            raise OracleError(f"{scene.describe(fixed[0])} is fixed to the table, so it cannot be swept.")

        def distance(goal: InZone) -> float:
            return scene[goal.object_id].pose.planar_distance(Pose.planar(goal.zone.x, goal.zone.y))

        blocks = [placement for placement in scene.placements if not placement.fixed]
        return View(
            goals=tuple(sorted(goals, key=distance)),
            footprints={b.id: Rectangle.of_box(b.pose, b.size[0], b.size[1]) for b in blocks},
            met_ids=frozenset(i for g in problem.goals if (i := object_of(g)) is not None)
            - {g.object_id for g in goals},
            lines=tuple(c.zone for c in problem.constraints if isinstance(c, NeverTouches)),
        )

    def place(self, goal: InZone) -> Point:
        """Centre of a goal's block."""
        footprint = self.footprints[goal.object_id]
        return footprint.x, footprint.y

    def after(self, goal: InZone, push: Push) -> "View":
        """Return the view after a push of the goal's block."""
        block = replace(self.footprints[goal.object_id], x=push.end[0], y=push.end[1], yaw_rad=push.yaw_rad)
        return replace(self, footprints=self.footprints | {goal.object_id: block})

    def only(self, goal: InZone) -> "View":
        """Return the same with no other goal."""
        return replace(self, goals=(goal,))

    def alone(self, goal: InZone) -> "View":
        """Return the same with no other goal and no other block."""
        return replace(self.only(goal), footprints={goal.object_id: self.footprints[goal.object_id]})

    def others(self, goal: InZone) -> Iterator[tuple[int, Rectangle]]:
        """Ids and footprints of all blocks but the goal's."""
        return ((i, block) for i, block in self.footprints.items() if i != goal.object_id)

    def cleared(self, goal: InZone, push: Push) -> Push | None:
        """Find a variant of a push of the goal's block without collisions, except for `overlap_m`.

        The block's way is the same in all variants and tested once, that of the spatula for each. The place
        where the spatula comes down must be free of all blocks, even of swept ones.

        Returns:
            The push, possibly with the spatula off-centre; None if every variant collides.
        """
        if touches_line(push, self.lines):
            return None
        others = [
            (block, -self.overlap_m if object_id in self.met_ids else 0.0)
            for object_id, block in self.others(goal)
        ]
        block_area = push.block_area()
        if any(block_area.comes_near(other, margin) for other, margin in others):
            return None
        for shifted in push.variants():
            spatula, spatula_area = shifted.spatula_at_start(), shifted.spatula_area()
            if not any(spatula_area.comes_near(o, m) or spatula.meets_box_around(o) for o, m in others):
                return shifted
        return None


def touches_line(push: Push, lines: Sequence[Zone]) -> bool:
    """Whether a pushed block may touch a line."""
    if any(_crosses(push, line) for line in lines):
        return True
    area = push.block_area()
    return any(area.comes_near(Rectangle.of_zone(line)) for line in lines)


def _crosses(push: Push, line: Zone) -> bool:
    """Whether the block's centre crosses the middle of a line: cheaper to test than areas, and most do."""
    (x0, y0), (x1, y1) = push.start, push.end
    if (x0 < line.x) == (x1 < line.x):
        return False
    return abs(y0 + (line.x - x0) / (x1 - x0) * (y1 - y0) - line.y) < line.size_y / 2


def ends(zone: Zone, start: Point) -> Iterator[Point]:
    """Points in a zone to push a block to: the middle, then farther to the sides, then deeper and nearer.

    Args:
        zone: The zone.
        start: Position of the block; its own side comes first.
    """
    side = 1 if start[1] >= zone.y else -1
    num_steps = int((zone.size_y / 2 - _END_EDGE_M) / _END_STEP_M + 1e-9)
    shifts = (0.0, *(sign * _END_STEP_M * step for step in range(1, num_steps + 1) for sign in (side, -side)))
    has_columns = zone.size_x / 2 > _COLUMN_STEP_M + _END_EDGE_M
    columns = (0.0, -_COLUMN_STEP_M, _COLUMN_STEP_M) if has_columns else (0.0,)
    return ((zone.x + column, zone.y + shift) for column in columns for shift in shifts)
