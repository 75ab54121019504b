"""What one push of a small block covers, and the sweep that makes it.

While a block is pushed, blade and block cover a rectangle, the way; the block alone covers its track. Of 240
simulated pushes of 0.05 to 0.3 m, no point of a block strayed more than 24 mm to the side, and none of the
blocks came to rest more than 8 mm beyond its end.
"""

import math
from dataclasses import dataclass

from openvima.scene import InZone
from openvima.tasks.footprints import Rectangle

Point = tuple[float, float]

STANDOFF_M = 0.006  # how far behind a block's centre a sweep starts: the blade then clears any of its corners
SHORTFALL_M = 0.0325  # how far short of a sweep's end the centre of the pushed block comes to rest
BLOCK_REACH_M = 0.0212  # from a block's centre to its corner
OVERRUN_M = 0.008  # how far a block may slide on

_BLADE_AT_M = 0.02  # where the blade comes down, behind the start of a sweep
_BLADE_HALF_THICKNESS_M = 0.0025
_BLADE_HALF_WIDTH_M = 0.025
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
    """

    start: Point
    end: Point
    ux: float
    uy: float
    length_m: float

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

    def sweep(self, goal: InZone) -> Sweep:
        """Return the sweep that pushes the goal's block like this."""
        start = (self.start[0] - STANDOFF_M * self.ux, self.start[1] - STANDOFF_M * self.uy)
        return Sweep(goal, start, (self.end[0] + SHORTFALL_M * self.ux, self.end[1] + SHORTFALL_M * self.uy))

    def way(self) -> Rectangle:
        """Everything that blade and block cover."""
        behind = STANDOFF_M + _BLADE_AT_M + _BLADE_HALF_THICKNESS_M
        return self._strip(behind, BLOCK_REACH_M + OVERRUN_M, half_width=_BLADE_HALF_WIDTH_M + _DRIFT_M)

    def track(self) -> Rectangle:
        """Everything that the block covers."""
        return self._strip(BLOCK_REACH_M, BLOCK_REACH_M + OVERRUN_M, half_width=BLOCK_REACH_M + _DRIFT_M)

    def blade(self) -> Rectangle:
        """Where the blade comes down."""
        behind = STANDOFF_M + _BLADE_AT_M
        x, y = self.start[0] - behind * self.ux, self.start[1] - behind * self.uy
        return Rectangle(x, y, self.yaw_rad, _BLADE_HALF_THICKNESS_M, _BLADE_HALF_WIDTH_M)

    def _strip(self, behind: float, ahead: float, *, half_width: float) -> Rectangle:
        """Rectangle from `behind` the start to `ahead` of the end."""
        half_length = (self.length_m + ahead + behind) / 2
        middle = half_length - behind
        x, y = self.start[0] + middle * self.ux, self.start[1] + middle * self.uy
        return Rectangle(x, y, self.yaw_rad, half_length, half_width)
