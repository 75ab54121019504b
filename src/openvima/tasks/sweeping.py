"""Planning of sweeps: which block to push, from where and how far, so that nothing else is moved.

The plan is pure geometry: a sweep is clear if its way comes near no other block and the block's track near
no line. Of the first sweeps of 500 episodes of `sweep_without_exceeding`, 95 % take the nearest block
straight to the middle of the zone; the others go elsewhere in it, move a block aside or part a tight group.
A line at the zone's mouth is passed in one sweep where there is room, else with one stop beside the line.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, InZone, Problem, Scene, Zone
from openvima.tasks.detours import waypoints
from openvima.tasks.footprints import Rectangle
from openvima.tasks.published_sweeps import published_sweep
from openvima.tasks.pushes import BLOCK_REACH_M, Point, Push, Sweep
from openvima.tasks.sweep_view import View, ends

_NUDGE_M, _SHOVE_M = 0.012, 0.03  # how far a way may overlap a block that counts already
_ASIDE_LENGTHS_M = (0.06, 0.1)
_ASIDE_ANGLES_RAD = tuple(2 * math.pi * step / 24 for step in range(24))
_PARKING_EDGE_M = 0.03  # a parked block keeps this far from the zone and the edge of the workspace


def plan_sweep(goals: Sequence[InZone], scene: Scene, problem: Problem, *, compat: bool = False) -> Sweep:
    """Choose the next sweep, the first of as few as possible.

    Args:
        goals: The open goals, at least one.
        scene: Where the objects are now.
        problem: The episode's problem.
        compat: Follow the original benchmark: push the first open block by its rule, whatever is in the way.
    """
    if compat:
        return published_sweep(goals[0], scene, problem)
    view = View.of(goals, scene, problem)
    nudging, shoving = replace(view, overlap_m=_NUDGE_M), replace(view, overlap_m=_SHOVE_M)
    sweeps = itertools.chain(
        _direct_sweeps(view),
        _direct_sweeps(nudging),
        _detours(view),
        _aside_sweeps(view),
        _direct_sweeps(shoving),
        _detours(shoving),
        _parting_sweeps(view),
        _last_resort(view),
    )
    return next(sweeps)


def _direct_sweeps(view: View) -> Iterator[Sweep]:
    """Clear sweeps that bring one block into the zone: to its middle, else beside it, the near side first."""
    if view.overlap_m and not view.met_ids:
        return  # nothing can be overlapped
    for pushes in itertools.zip_longest(*(_pushes_into_zone(view, goal) for goal in view.goals)):
        for goal, push in zip(view.goals, pushes, strict=True):
            clear = push and view.cleared(goal, push)
            if clear:
                yield clear.sweep(goal)


def _pushes_into_zone(view: View, goal: InZone) -> Iterator[Push]:
    place = view.place(goal)
    return (Push.between(place, end) for end in ends(goal.zone, place))


def _detours(view: View) -> Iterator[Sweep]:
    """Clear sweeps to a stop beside the line from where the same block can go straight on, shortest first."""
    stops = [
        (math.dist(view.place(goal), waypoint.point) + waypoint.rest_m, rank, waypoint.point)
        for rank, goal in enumerate(view.goals)
        for waypoint in waypoints(goal.zone, view.lines)
    ]
    for _, rank, stop in sorted(stops):
        goal = view.goals[rank]
        push = view.cleared(goal, Push.between(view.place(goal), stop))
        if push and _can_finish(view.after(goal, push).only(goal)):
            yield push.sweep(goal)


def _aside_sweeps(view: View) -> Iterator[Sweep]:
    """Clear sweeps that park a block elsewhere, so that a direct sweep becomes possible."""
    for goal, push in _parking_pushes(view):
        clear = view.cleared(goal, push)
        if clear and _can_finish(view.after(goal, clear)):
            yield clear.sweep(goal)


def _can_finish(view: View) -> bool:
    return any(True for _ in _direct_sweeps(view))


def _parting_sweeps(view: View) -> Iterator[Sweep]:
    """Sweeps that park a block of a group too tight for the blade; other open blocks may be pushed along.

    The blade still comes down on free ground. First come those that push nothing along at the workspace's
    edge, and of these the ones whose ways cover least of the others' width.
    """
    open_ids = {goal.object_id for goal in view.goals}
    candidates: list[tuple[bool, float, int, Sweep]] = []
    for goal, push in _parking_pushes(view):
        group = [block for object_id, block in view.others(goal) if object_id in open_ids]
        apart = [block for object_id, block in view.others(goal) if object_id not in open_ids]
        apart += [Rectangle.of_zone(line) for line in view.lines]
        for shifted in push.variants():
            ways = (shifted.blade_way(), shifted.block_way())
            blade = shifted.blade_at_start()
            if any(blade.meets_box_around(block) for block in group):
                continue
            # Room for what is pushed along.
            if any(way.comes_near(other, 2 * BLOCK_REACH_M) for way in ways for other in apart):
                continue
            moved = [block for block in group if any(way.comes_near(block) for way in ways)]
            risky = not all(_stays(block, shifted) for block in moved)
            cover = max((_cover(way, block) for way in ways for block in moved), default=0.0)
            candidates.append((risky, cover, len(candidates), shifted.sweep(goal)))
    yield from (sweep for *_, sweep in sorted(candidates, key=lambda candidate: candidate[:3]))


def _last_resort(view: View) -> Iterator[Sweep]:
    """The nearest block straight to the zone's middle, whatever is in the way."""
    goal = view.goals[0]
    yield Push.between(view.place(goal), (goal.zone.x, goal.zone.y)).sweep(goal)


def _parking_pushes(view: View) -> Iterator[tuple[InZone, Push]]:
    """Goals, and pushes of their blocks to points nearby, inside the workspace and outside of the zone."""
    for length in _ASIDE_LENGTHS_M:
        for goal in view.goals:
            x, y = view.place(goal)
            for angle in _ASIDE_ANGLES_RAD:
                end = (x + length * math.cos(angle), y + length * math.sin(angle))
                if _may_park(end, goal.zone):
                    yield goal, Push.between((x, y), end)


def _may_park(point: Point, zone: Zone) -> bool:
    edge = _PARKING_EDGE_M
    beside_zone = abs(point[1] - zone.y) > zone.size_y / 2 + edge and point[0] > zone.x
    before_zone = point[0] > zone.x + zone.size_x / 2 + edge
    return (beside_zone or before_zone) and _is_inside(point, edge)


def _is_inside(point: Point, edge_m: float) -> bool:
    """Whether a point lies in the workspace and keeps off its edge."""
    return all(
        low + edge_m < value < high - edge_m
        for value, low, high in zip(point, WORKSPACE_LOW, WORKSPACE_HIGH, strict=True)
    )


def _stays(block: Rectangle, push: Push) -> bool:
    """Whether a block that is pushed along stays in the workspace: at most it goes before the pushed one."""
    x, y = push.start
    ahead = (block.x - x) * push.ux + (block.y - y) * push.uy
    distance = max(0.0, push.length_m + 2 * BLOCK_REACH_M - ahead)
    places = ((block.x + way * push.ux, block.y + way * push.uy) for way in (0.0, distance))
    return all(_is_inside(place, BLOCK_REACH_M) for place in places)


def _cover(way: Rectangle, footprint: Rectangle) -> float:
    """Width of a footprint, in metres, that lies within the way's width."""
    across = way.yaw_rad + math.pi / 2
    offset = (footprint.x - way.x) * math.cos(across) + (footprint.y - way.y) * math.sin(across)
    return way.half_y + footprint.half_width(across) - abs(offset)
