"""Planning of sweeps: which block to push, from where and how far, so that nothing else is moved.

The plan is pure geometry. A sweep is clear if neither the blade, where it comes down and along its way, nor
the pushed block would come near any other block.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from openvima.scene import InZone, Placement, Pose, Problem, Scene, Zone, in_workspace
from openvima.tasks.footprints import Rectangle

STANDOFF_M = 0.006  # how far behind a block's centre a sweep starts: the blade then clears any of its corners
SHORTFALL_M = 0.0325  # how far short of a sweep's end the centre of the pushed block comes to rest

_BLADE_BEHIND_M = 0.02 + 0.0025  # the blade's back at the start of a sweep, behind its pose0
_HALF_WIDTH_M = 0.025 + 0.003  # half of the blade, and what the block may drift to the side while it turns
_BLOCK_REACH_M = 0.0212  # from a block's centre to its corner
_OVERRUN_M = 0.006  # how far a block may slide on
_GAP_M = 0.002
_END_SHIFTS_M = (0.0, 0.03, -0.03, 0.055, -0.055, 0.075, -0.075, 0.105, -0.105)  # along y, block's side first
_CLEARING_LENGTHS_M = (0.06, 0.1)
_NUM_CLEARING_DIRECTIONS = 24


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
    blocks = [p for p in scene.placements if not p.fixed]
    nearest_first = sorted(goals, key=lambda goal: _distance_to_zone(goal, scene))
    for sweep in _direct_sweeps(nearest_first, blocks):
        return sweep
    for sweep in _clearing_sweeps(nearest_first, blocks):
        return sweep
    for sweep in _parting_sweeps(nearest_first, blocks):
        return sweep
    goal = nearest_first[0]
    return _push(goal, scene[goal.object_id].pose, (goal.zone.x, goal.zone.y))


def _distance_to_zone(goal: InZone, scene: Scene) -> float:
    pose = scene[goal.object_id].pose
    return math.hypot(pose.x - goal.zone.x, pose.y - goal.zone.y)


def _direct_sweeps(goals: Sequence[InZone], blocks: Sequence[Placement]) -> Iterator[Sweep]:
    """Clear sweeps that bring one block into the zone, the most usual form first."""
    by_id = {block.id: block for block in blocks}
    for shift in _END_SHIFTS_M:
        for goal in goals:
            pose = by_id[goal.object_id].pose
            end = (goal.zone.x, goal.zone.y + math.copysign(1.0, pose.y) * shift)
            if _is_clear(goal.object_id, pose, end, blocks):
                yield _push(goal, pose, end)


def _clearing_sweeps(goals: Sequence[InZone], blocks: Sequence[Placement]) -> Iterator[Sweep]:
    """Clear sweeps that move a block aside so that a direct one becomes possible."""
    for length in _CLEARING_LENGTHS_M:
        for goal in goals:
            block = next(block for block in blocks if block.id == goal.object_id)
            for step in range(_NUM_CLEARING_DIRECTIONS):
                angle = 2 * math.pi * step / _NUM_CLEARING_DIRECTIONS
                end = (block.pose.x + length * math.cos(angle), block.pose.y + length * math.sin(angle))
                if not _is_free_ground(end, goal.zone) or not _is_clear(block.id, block.pose, end, blocks):
                    continue
                moved = [b.at(Pose.planar(*end, angle)) if b.id == block.id else b for b in blocks]
                if any(True for _ in _direct_sweeps(goals, moved)):
                    yield _push(goal, block.pose, end)


def _parting_sweeps(goals: Sequence[InZone], blocks: Sequence[Placement]) -> Iterator[Sweep]:
    """Sweeps away from the zone that take a block out of a tight group, brushing others of the group at most.

    The first is the one that overlaps least with them across its way.
    """
    movable = {goal.object_id for goal in goals}
    candidates = []
    for goal in goals:
        block = next(block for block in blocks if block.id == goal.object_id)
        others = [b for b in blocks if b.id in movable and b.id != block.id]
        for step in range(_NUM_CLEARING_DIRECTIONS):
            angle = 2 * math.pi * step / _NUM_CLEARING_DIRECTIONS
            for length in _CLEARING_LENGTHS_M:
                end = (block.pose.x + length * math.cos(angle), block.pose.y + length * math.sin(angle))
                if not _is_free_ground(end, goal.zone):
                    continue
                way, blade = _way(block.pose, end), _blade(block.pose, angle)
                near = [b for b in others if way.comes_near(_footprint(b), _GAP_M)]
                if any(blade.comes_near(_footprint(b), _GAP_M) for b in others):
                    continue
                if any(_wide(way).comes_near(_footprint(b)) for b in blocks if b.id not in movable):
                    continue
                overlap = max((_overlap_across(way, _footprint(b)) for b in near), default=0.0)
                candidates.append((overlap, len(candidates), _push(goal, block.pose, end)))
    for _, _, sweep in sorted(candidates, key=lambda c: c[:2]):
        yield sweep


def _overlap_across(way: Rectangle, footprint: Rectangle) -> float:
    across = way.yaw_rad + math.pi / 2
    offset = (footprint.x - way.x) * math.cos(across) + (footprint.y - way.y) * math.sin(across)
    return way.half_y + footprint.half_width(across) - abs(offset)


def _wide(way: Rectangle) -> Rectangle:
    return Rectangle(way.x, way.y, way.yaw_rad, way.half_x + 0.03, way.half_y + 0.04)


def _blade(pose: Pose, angle: float) -> Rectangle:
    d = STANDOFF_M + 0.02
    return Rectangle(
        pose.x - d * math.cos(angle), pose.y - d * math.sin(angle), angle, 0.0025 + 0.001, _HALF_WIDTH_M
    )


def _is_free_ground(point: tuple[float, float], zone: Zone) -> bool:
    """Whether a block may be parked at a point: well inside the workspace and well outside of the zone."""
    edge = 0.03
    corners = [Pose.planar(point[0] + dx, point[1] + dy) for dx in (-edge, edge) for dy in (-edge, edge)]
    in_zone = (
        abs(point[0] - zone.x) < zone.size_x / 2 + edge and abs(point[1] - zone.y) < zone.size_y / 2 + edge
    )
    return point[0] > zone.x and not in_zone and all(in_workspace(corner) for corner in corners)


def _is_clear(block_id: int, pose: Pose, end: tuple[float, float], blocks: Sequence[Placement]) -> bool:
    """Whether a block can be pushed to a point without anything coming near another block."""
    way = _way(pose, end)
    return not any(way.comes_near(_footprint(block), _GAP_M) for block in blocks if block.id != block_id)


def _way(pose: Pose, end: tuple[float, float]) -> Rectangle:
    dx, dy = end[0] - pose.x, end[1] - pose.y
    length = math.hypot(dx, dy)
    if length < 1e-6:
        dx, dy, length = -1e-6, 0.0, 1e-6
    back, front = STANDOFF_M + _BLADE_BEHIND_M, length + _BLOCK_REACH_M + _OVERRUN_M
    middle = (front - back) / 2
    return Rectangle(
        pose.x + middle * dx / length,
        pose.y + middle * dy / length,
        math.atan2(dy, dx),
        (front + back) / 2,
        _HALF_WIDTH_M,
    )


def _footprint(block: Placement) -> Rectangle:
    return Rectangle.of_box(block.pose, block.size[0], block.size[1])


def _push(goal: InZone, pose: Pose, end: tuple[float, float]) -> Sweep:
    """Sweep that brings the centre of the goal's block from its pose to a point."""
    dx, dy = end[0] - pose.x, end[1] - pose.y
    length = math.hypot(dx, dy)
    ux, uy = (dx / length, dy / length) if length > 0 else (-1.0, 0.0)
    start = (pose.x - STANDOFF_M * ux, pose.y - STANDOFF_M * uy)
    return Sweep(goal, start, (end[0] + SHORTFALL_M * ux, end[1] + SHORTFALL_M * uy))
