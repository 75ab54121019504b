"""Ways around a line that lies between blocks and zone: where to push a block first."""

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

from openvima.scene import WORKSPACE_HIGH, Zone
from openvima.tasks.pushes import BLOCK_REACH_M, Point, Push
from openvima.tasks.sweep_view import ends, touches_line

_STEP_M = 0.03
_BESIDE_M = (0.03, 0.23)  # how far beside a line's end the waypoints lie
_EDGE_M = 0.05  # left free at the workspace's edge
_MARGIN_M = 0.005  # a block comes to rest that far from its waypoint


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A point from which a block can be pushed straight into the zone.

    Args:
        point: x, y in metres.
        rest_m: Length of the shortest such push.
    """

    point: Point
    rest_m: float


@functools.lru_cache(maxsize=32)
def waypoints(zone: Zone, lines: tuple[Zone, ...]) -> tuple[Waypoint, ...]:
    """Points beside the lines in front of a zone, as if there were no other blocks.

    Args:
        zone: Where blocks have to go, from farther away from the robot.
        lines: What they may not touch; lines behind the zone are in nobody's way.
    """
    wider = tuple(
        replace(line, size_x=line.size_x + 2 * _MARGIN_M, size_y=line.size_y + 2 * _MARGIN_M)
        for line in lines
    )
    found = []
    for point in itertools.chain.from_iterable(_beside(line, zone) for line in lines if line.x > zone.x):
        if touches_line(Push.between(point, point), wider):
            continue
        pushes = [Push.between(point, end) for end in ends(zone, point)]
        lengths = [push.length_m for push in pushes if not touches_line(push, wider)]
        if lengths:
            found.append(Waypoint(point, min(lengths)))
    return tuple(found)


def _beside(line: Zone, zone: Zone) -> Iterator[Point]:
    """A grid of points to either side of a line, along the whole way from far away into the zone."""
    xs = _steps(zone.x - zone.size_x / 2 + _EDGE_M, WORKSPACE_HIGH[0] - _EDGE_M)
    first = line.size_y / 2 + _BESIDE_M[0]
    farthest = min(line.size_y / 2 + _BESIDE_M[1], WORKSPACE_HIGH[1] - _EDGE_M)
    for x, shift, side in itertools.product(xs, _steps(first, farthest), (1, -1)):
        in_zone = (
            abs(x - zone.x) < zone.size_x / 2 + BLOCK_REACH_M and shift < zone.size_y / 2 + BLOCK_REACH_M
        )
        if not in_zone:
            yield x, line.y + side * shift


def _steps(low: float, high: float) -> list[float]:
    return [low + _STEP_M * step for step in range(int((high - low) / _STEP_M) + 1)]
