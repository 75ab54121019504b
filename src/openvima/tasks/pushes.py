"""What one push of a small block covers, and the sweep that makes it.

Of 480 simulated pushes of 0.05 to 0.3 m, the blade's middle up to 15 mm beside the block's, no point of a
block strayed more than 24 mm to the side, and no block came to rest more than 9 mm beyond its end.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, InZone
from openvima.tasks.footprints import Rectangle

Point = tuple[float, float]

STANDOFF_M = 0.006  # how far behind a block's centre a sweep starts: the blade then clears any of its corners
SHORTFALL_M = 0.0325  # how far short of a sweep's end the centre of the pushed block comes to rest
BLOCK_HALF_M, BLOCK_REACH_M = 0.015, 0.0212  # from a block's centre to its face and to its corner
OVERRUN_M = 0.009  # how far a block may slide on

_ASIDE_M = 0.015  # how far beside a block's centre the middle of the blade may be

_BLADE_AT_M = 0.02  # where the blade comes down, behind the start of a sweep
_BLADE_HALF_THICKNESS_M = 0.0025
_BLADE_HALF_WIDTH_M = 0.025
_BLADE_GAP_M = 0.002  # kept free on either side of the blade
_DRIFT_M = 0.005  # what a block moves to the side while it turns


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
        start, end: Where from and where to, x and y in metres.
        ux, uy: Unit vector of the push.
        length_m: Its length.
        aside_m: How far to the left of the line the middle of the blade is.
    """

    start: Point
    end: Point
    ux: float
    uy: float
    length_m: float
    aside_m: float = 0.0

    @staticmethod
    def between(start: Point, end: Point) -> "Push":
        """Return the push from one point to another; one of no length points towards the robot."""
        dx, dy = end[0] - start[0], end[1] - start[1]
        length = math.hypot(dx, dy)
        ux, uy = (dx / length, dy / length) if length > 0 else (-1.0, 0.0)
        return Push(start, end, ux, uy, length)

    @property
    def yaw_rad(self) -> float:
        """Direction of the push."""
        return math.atan2(self.uy, self.ux)

    def variants(self) -> Iterator["Push"]:
        """The same push with the blade in the middle of the block, to the left of it and to the right.

        Left out are those that actions, which stay in the workspace, cannot describe; behind a block at its
        edge a sweep may start a little nearer.
        """
        for aside_m in (0.0, _ASIDE_M, -_ASIDE_M):
            push = replace(self, aside_m=aside_m)
            if is_inside(push._first(), -STANDOFF_M) and is_inside(push._last(), 0.0):
                yield push

    def sweep(self, goal: InZone) -> Sweep:
        """Return the sweep that pushes the goal's block like this."""
        return Sweep(goal, self._first(), self._last())

    def blade_at_start(self) -> Rectangle:
        """Where the blade comes down."""
        x, y = self._point(-STANDOFF_M - _BLADE_AT_M)
        return Rectangle(x, y, self.yaw_rad, _BLADE_HALF_THICKNESS_M, _BLADE_HALF_WIDTH_M + _BLADE_GAP_M)

    def blade_way(self) -> Rectangle:
        """Everything that the blade covers."""
        behind = STANDOFF_M + _BLADE_AT_M + _BLADE_HALF_THICKNESS_M
        half_width = _BLADE_HALF_WIDTH_M + _BLADE_GAP_M
        return self._strip(behind, -BLOCK_HALF_M, half_width=half_width, aside_m=self.aside_m)

    def block_way(self) -> Rectangle:
        """Everything that the block covers."""
        return self._strip(BLOCK_REACH_M, BLOCK_REACH_M + OVERRUN_M, half_width=BLOCK_REACH_M + _DRIFT_M)

    def ways(self) -> tuple[Rectangle, Rectangle]:
        """Everything that is covered: the ways of blade and block."""
        return self.blade_way(), self.block_way()

    def _first(self) -> Point:
        return self._point(-STANDOFF_M)

    def _last(self) -> Point:
        return self._point(self.length_m + SHORTFALL_M)

    def _point(self, along_m: float) -> Point:
        """Point on the line of the blade's middle, so far after the block's start."""
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
    """Whether a point lies in the workspace and keeps off its edge; if negative, so far outside will do."""
    return all(
        low + edge_m <= value <= high - edge_m
        for value, low, high in zip(point, WORKSPACE_LOW, WORKSPACE_HIGH, strict=True)
    )
