"""Sweeps as the original benchmark's oracle makes them: one block after another, whatever is in the way."""

import math

from openvima.scene import WORKSPACE_HIGH, InZone, NeverTouches, Problem, Scene
from openvima.tasks.pushes import Point, Sweep

# Around a line in front of the zone, metres.
_DIVIDER_M, _LANE_M = 0.05, 0.1  # beyond the line's end: where being beside it begins, and the lane there
_PAST_LINE_M = 0.04  # towards the robot from the line's middle
_BEHIND_CENTRE_M = 0.02  # towards the robot from the zone's middle


def published_sweep(goal: InZone, scene: Scene, problem: Problem) -> Sweep:
    """Sweep from the middle of the goal's block towards the zone, around a line in front of it.

    Args:
        goal: The first open goal.
        scene: Where the objects are now.
        problem: The episode's problem.
    """
    pose = scene[goal.object_id].pose
    place = (pose.x, pose.y)
    return Sweep(goal, place, _target(goal, place, problem))


def _target(goal: InZone, place: Point, problem: Problem) -> Point:
    (x, y), zone = place, goal.zone
    for line in (c.zone for c in problem.constraints if isinstance(c, NeverTouches) and c.zone.x > zone.x):
        half_length, side = line.size_y / 2, -1.0 if y < 0 else 1.0
        lane_y = math.copysign(half_length + _LANE_M, side)
        is_beside = abs(y) >= half_length + _DIVIDER_M
        if not is_beside and x > line.x:
            return (line.x + WORKSPACE_HIGH[0]) / 2, lane_y
        if is_beside and x > line.x - _PAST_LINE_M:
            return zone.x - _BEHIND_CENTRE_M, lane_y
    return zone.x, zone.y
