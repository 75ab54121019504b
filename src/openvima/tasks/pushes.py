"""Geometry of pushes of small blocks, and of the sweeps that perform them.

Of 480 simulated pushes of 0.05 to 0.3 m, the spatula's middle up to 15 mm beside the block's, no point of a
block strayed more than 24 mm to the side, and no block came to rest more than 9 mm beyond its end.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, InZone
from openvima.tasks.footprints import Rectangle

Point = tuple[float, float]

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
