"""Sweeps that separate blocks too close to be swept one by one."""

import math
from collections.abc import Iterator

from openvima.scene import InZone, Zone
from openvima.tasks.footprints import Rectangle
from openvima.tasks.pushes import BLOCK_REACH_M, Point, Push, Sweep, is_inside
from openvima.tasks.sweep_view import View

_LENGTHS_M = (0.06, 0.1)
_ANGLES_RAD = tuple(2 * math.pi * step / 24 for step in range(24))
_EDGE_M = 0.03  # a parked block keeps this far from the zone and the edge of the workspace
_ROOM_M = 2 * BLOCK_REACH_M  # for a block that is pushed along


def parking_pushes(view: View) -> Iterator[tuple[InZone, Push]]:
    """Goals, and pushes of their blocks to points nearby, inside the workspace and outside of the zone."""
    for length in _LENGTHS_M:
        for goal in view.goals:
            x, y = view.place(goal)
            for angle in _ANGLES_RAD:
                end = (x + length * math.cos(angle), y + length * math.sin(angle))
                if _may_park(end, goal.zone):
                    yield goal, Push.between((x, y), end)


def separating_sweeps(view: View) -> Iterator[Sweep]:
    """Sweeps that park a block of a tight group, at which other blocks to sweep may be pushed along.

    The spatula still comes down on free ground. First come the sweeps that push nothing along at the edge of
    the workspace, and of these the ones whose ways cover least of the others' width.
    """
    open_ids = {goal.object_id for goal in view.goals}
    candidates: list[tuple[bool, float, int, Sweep]] = []
    for goal, centred in parking_pushes(view):
        group = [block for object_id, block in view.others(goal) if object_id in open_ids]
        apart = [block for object_id, block in view.others(goal) if object_id not in open_ids]
        apart += [Rectangle.of_zone(line) for line in view.lines]
        for push in centred.variants():
            if _comes_down_on(push, group) or _come_near(push, apart, margin_m=_ROOM_M):
                continue
            pushed_along = [block for block in group if _come_near(push, [block])]
            is_risky = not all(_stays(block, push) for block in pushed_along)
            cover = max((_cover(push, block) for block in pushed_along), default=0.0)
            candidates.append((is_risky, cover, len(candidates), push.sweep(goal)))
    yield from (sweep for *_, sweep in sorted(candidates, key=lambda candidate: candidate[:3]))


def _may_park(point: Point, zone: Zone) -> bool:
    beside_zone = abs(point[1] - zone.y) > zone.size_y / 2 + _EDGE_M and point[0] > zone.x
    before_zone = point[0] > zone.x + zone.size_x / 2 + _EDGE_M
    return (beside_zone or before_zone) and is_inside(point, _EDGE_M)


def _comes_down_on(push: Push, blocks: list[Rectangle]) -> bool:
    spatula = push.spatula_at_start()
    return any(spatula.meets_box_around(block) for block in blocks)


def _come_near(push: Push, others: list[Rectangle], *, margin_m: float = 0.0) -> bool:
    """Whether spatula or block come near one of the others."""
    return any(way.comes_near(other, margin_m) for way in push.swept_areas() for other in others)


def _stays(block: Rectangle, push: Push) -> bool:
    """Whether a block that is pushed along stays in the workspace: at most it goes before the pushed one."""
    x, y = push.start
    ahead = (block.x - x) * push.ux + (block.y - y) * push.uy
    distance = max(0.0, push.length_m + 2 * BLOCK_REACH_M - ahead)
    places = ((block.x + way * push.ux, block.y + way * push.uy) for way in (0.0, distance))
    return all(is_inside(place, BLOCK_REACH_M) for place in places)


def _cover(push: Push, block: Rectangle) -> float:
    """Width of a block, in metres, that is in the way of spatula or block."""
    across = push.yaw_rad + math.pi / 2
    cos, sin = math.cos(across), math.sin(across)
    reach = block.half_width(across)
    offsets = ((way, abs((block.x - way.x) * cos + (block.y - way.y) * sin)) for way in push.swept_areas())
    return max(way.half_y + reach - offset for way, offset in offsets)
