"""Waypoints around a line between blocks and zone."""

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

from openvima.scene import WORKSPACE_HIGH, Zone
from openvima.tasks.pushes import BLOCK_REACH_M, Point, Push
from openvima.tasks.sweep_view import ends, touches_line

_STEP_M = 0.03
_BESIDE_M = (0.03, 0.23)  # distance of the waypoints from a line's end
_EDGE_M = 0.05  # left free at the workspace's edge
_MARGIN_M = 0.005  # deviation of a pushed block from its waypoint


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A point from which a block has a straight path into the zone.

    Args:
        point: x, y in metres.
        rest_m: Length of the shortest such push.
    """

    point: Point
    rest_m: float


@functools.lru_cache(maxsize=32)
def waypoints(zone: Zone, lines: tuple[Zone, ...]) -> tuple[Waypoint, ...]:
    """Waypoints beside the lines in front of a zone, other blocks ignored.

    Args:
        zone: Goal of the blocks, which come from farther away from the robot.
        lines: Forbidden zones; lines behind the zone do not matter.
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
    """A grid of points on both sides of a line."""
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
