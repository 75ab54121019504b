"""Planning of sweeps: which block to push, from where and how far, so that nothing else is moved.

The plan is pure geometry. While a block is pushed, blade and block cover a rectangle, the way; a sweep is
clear if its way comes near no other block. Of the first sweeps of 500 episodes, 95 % take the nearest block
straight to the middle of the zone; the others go elsewhere in it, move a block aside or part a tight group.
"""

import itertools
import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

from openvima.scene import InZone, Placement, Pose, Problem, Scene, Zone, in_workspace
from openvima.tasks.footprints import Rectangle

STANDOFF_M = 0.006  # how far behind a block's centre a sweep starts: the blade then clears any of its corners
SHORTFALL_M = 0.0325  # how far short of a sweep's end the centre of the pushed block comes to rest

_BLADE_AT_M = 0.02  # where the blade comes down, behind the start of a sweep
_BLADE_HALF_THICKNESS_M = 0.0025
_HALF_WIDTH_M = 0.025 + 0.005  # half of the blade, and what a block drifts to the side while it turns
_BLOCK_REACH_M = 0.0212  # from a block's centre to its corner
_OVERRUN_M = 0.008  # a block slides on by up to 5 mm
_NUDGE_M, _SHOVE_M = 0.012, 0.03  # how far a way may overlap a block in the zone that counts already

_END_SHIFTS_M = (0.0, *(sign * 0.015 * step for step in range(1, 8) for sign in (1, -1)))
_ASIDE_LENGTHS_M = (0.06, 0.1)
_ASIDE_ANGLES_RAD = tuple(2 * math.pi * step / 24 for step in range(24))
_PARKING_EDGE_M = 0.03  # a parked block keeps this far from the zone and the edge of the workspace


@dataclass(frozen=True, slots=True)
class Sweep:
    """One sweep.

    Args:
        goal: The goal whose block is pushed.
        start: pose0, x and y in metres.
        end: pose1.
    """

    goal: InZone
    start: tuple[float, float]
    end: tuple[float, float]


def plan_sweep(goals: Sequence[InZone], scene: Scene, problem: Problem, *, compat: bool = False) -> Sweep:
    """Choose the next sweep.

    Args:
        goals: The open goals, at least one.
        scene: Where the objects are now.
        problem: The episode's problem.
        compat: Push the first open block towards the zone's middle, whatever is in the way.
    """
    if compat:
        goal = goals[0]
        pose = scene[goal.object_id].pose
        return Sweep(goal, (pose.x, pose.y), (goal.zone.x, goal.zone.y))
    nearest_first = sorted(goals, key=lambda goal: _distance_to_zone(scene[goal.object_id].pose, goal.zone))
    open_ids = {goal.object_id for goal in goals}
    met_ids = {goal.object_id for goal in problem.goals} - open_ids
    blocks = [placement for placement in scene.placements if not placement.fixed]
    sweeps = itertools.chain(
        _direct_sweeps(nearest_first, blocks),
        _direct_sweeps(nearest_first, blocks, swept_ids=met_ids, overlap_m=_NUDGE_M),
        _aside_sweeps(nearest_first, blocks),
        _direct_sweeps(nearest_first, blocks, swept_ids=met_ids, overlap_m=_SHOVE_M),
        _parting_sweeps(nearest_first, blocks, may_move=open_ids),
        _last_resort(nearest_first, blocks),
    )
    return next(sweeps)


def _distance_to_zone(pose: Pose, zone: Zone) -> float:
    return math.hypot(pose.x - zone.x, pose.y - zone.y)


def _direct_sweeps(
    goals: Sequence[InZone],
    blocks: Sequence[Placement],
    *,
    swept_ids: Collection[int] = (),
    overlap_m: float = 0.0,
) -> Iterator[Sweep]:
    """Clear sweeps that bring one block into the zone: to its middle, else beside it, the near side first.

    The way may overlap blocks of `swept_ids`: they count as swept already, and the blade stops too far before
    the line to push them onto it.
    """
    poses = {block.id: block.pose for block in blocks}
    for shift in _END_SHIFTS_M:
        for goal in goals:
            pose = poses[goal.object_id]
            end = (goal.zone.x, goal.zone.y + math.copysign(shift, shift * pose.y))
            way = _way(pose, end)
            others = [block for block in blocks if block.id != goal.object_id]
            margins = [-overlap_m if block.id in swept_ids else 0.0 for block in others]
            if not any(way.comes_near(_footprint(b), m) for b, m in zip(others, margins, strict=True)):
                yield _push(goal, pose, end)


def _aside_sweeps(goals: Sequence[InZone], blocks: Sequence[Placement]) -> Iterator[Sweep]:
    """Clear sweeps that park a block elsewhere, so that a direct sweep becomes possible."""
    for goal, block, end in _parking_places(goals, blocks):
        others = [other for other in blocks if other.id != block.id]
        way = _way(block.pose, end)
        if any(way.comes_near(_footprint(other)) for other in others):
            continue
        parked = block.at(Pose.planar(*end, way.yaw_rad))
        if any(True for _ in _direct_sweeps(goals, [*others, parked])):
            yield _push(goal, block.pose, end)


def _parting_sweeps(
    goals: Sequence[InZone], blocks: Sequence[Placement], *, may_move: set[int]
) -> Iterator[Sweep]:
    """Sweeps that park a block of a group too tight for the blade; others of `may_move` may be pushed along.

    The blade still comes down on free ground. First come those whose way covers least of the others' width.
    """
    candidates: list[tuple[float, int, Sweep]] = []
    for goal, block, end in _parking_places(goals, blocks):
        way = _way(block.pose, end)
        group = [_footprint(other) for other in blocks if other.id in may_move and other.id != block.id]
        apart = [_footprint(other) for other in blocks if other.id not in may_move]
        blade = _blade_at_start(block.pose, way.yaw_rad)
        if any(blade.comes_near(other) for other in group):
            continue
        if any(way.comes_near(other, 2 * _BLOCK_REACH_M) for other in apart):  # room for what is pushed along
            continue
        cover = max((_cover(way, other) for other in group if way.comes_near(other)), default=0.0)
        candidates.append((cover, len(candidates), _push(goal, block.pose, end)))
    yield from (sweep for _, _, sweep in sorted(candidates, key=lambda candidate: candidate[:2]))


def _last_resort(goals: Sequence[InZone], blocks: Sequence[Placement]) -> Iterator[Sweep]:
    """The nearest block straight to the zone's middle, whatever is in the way."""
    goal = goals[0]
    pose = next(block.pose for block in blocks if block.id == goal.object_id)
    yield _push(goal, pose, (goal.zone.x, goal.zone.y))


def _parking_places(
    goals: Sequence[InZone], blocks: Sequence[Placement]
) -> Iterator[tuple[InZone, Placement, tuple[float, float]]]:
    """Goals, their blocks, and points around these well inside the workspace and outside of the zone."""
    of_id = {block.id: block for block in blocks}
    for length in _ASIDE_LENGTHS_M:
        for goal in goals:
            block = of_id[goal.object_id]
            for angle in _ASIDE_ANGLES_RAD:
                end = (block.pose.x + length * math.cos(angle), block.pose.y + length * math.sin(angle))
                if _may_park(end, goal.zone):
                    yield goal, block, end


def _may_park(point: tuple[float, float], zone: Zone) -> bool:
    edge = _PARKING_EDGE_M
    corners = [Pose.planar(point[0] + dx, point[1] + dy) for dx in (-edge, edge) for dy in (-edge, edge)]
    beside_zone = abs(point[1] - zone.y) > zone.size_y / 2 + edge and point[0] > zone.x
    before_zone = point[0] > zone.x + zone.size_x / 2 + edge
    return (beside_zone or before_zone) and all(in_workspace(corner) for corner in corners)


def _way(pose: Pose, end: tuple[float, float]) -> Rectangle:
    """Everything that blade and block cover while the block's centre is pushed from its pose to a point."""
    ux, uy, length = _direction(pose, end)
    back = STANDOFF_M + _BLADE_AT_M + _BLADE_HALF_THICKNESS_M
    front = length + _BLOCK_REACH_M + _OVERRUN_M
    middle = (front - back) / 2
    return Rectangle(
        pose.x + middle * ux, pose.y + middle * uy, math.atan2(uy, ux), (front + back) / 2, _HALF_WIDTH_M
    )


def _blade_at_start(pose: Pose, yaw_rad: float) -> Rectangle:
    """Where the blade comes down behind a block."""
    distance = STANDOFF_M + _BLADE_AT_M
    x, y = pose.x - distance * math.cos(yaw_rad), pose.y - distance * math.sin(yaw_rad)
    return Rectangle(x, y, yaw_rad, _BLADE_HALF_THICKNESS_M, _HALF_WIDTH_M)


def _cover(way: Rectangle, footprint: Rectangle) -> float:
    """Width of a footprint, in metres, that lies within the way's width."""
    across = way.yaw_rad + math.pi / 2
    offset = (footprint.x - way.x) * math.cos(across) + (footprint.y - way.y) * math.sin(across)
    return way.half_y + footprint.half_width(across) - abs(offset)


def _footprint(block: Placement) -> Rectangle:
    return Rectangle.of_box(block.pose, block.size[0], block.size[1])


def _push(goal: InZone, pose: Pose, end: tuple[float, float]) -> Sweep:
    """Sweep that brings the centre of the goal's block from its pose to a point."""
    ux, uy, _ = _direction(pose, end)
    start = (pose.x - STANDOFF_M * ux, pose.y - STANDOFF_M * uy)
    return Sweep(goal, start, (end[0] + SHORTFALL_M * ux, end[1] + SHORTFALL_M * uy))


def _direction(pose: Pose, end: tuple[float, float]) -> tuple[float, float, float]:
    """Unit vector from a pose to a point, and the distance; towards the robot if they coincide."""
    dx, dy = end[0] - pose.x, end[1] - pose.y
    length = math.hypot(dx, dy)
    return (dx / length, dy / length, length) if length > 0 else (-1.0, 0.0, 0.0)
