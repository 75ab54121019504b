"""Planning of sweeps: which block to push, from where and how far, so that nothing else is moved."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from openvima.errors import OracleError
from openvima.scene import InZone, Problem, Scene

STANDOFF_M = 0.006  # how far behind a block's centre a sweep starts: the blade then clears any of its corners
SHORTFALL_M = 0.0325  # how far short of a sweep's end the centre of the pushed block comes to rest


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
        problem: The episode's problem; its constraints say what must not be moved.
        compat: Push the first open block towards the zone's middle, whatever is in the way.
    """
    if compat:
        goal = goals[0]
        pose = scene[goal.object_id].pose
        return Sweep(goal, (pose.x, pose.y), (goal.zone.x, goal.zone.y))

    def distance(goal: InZone) -> float:
        pose = scene[goal.object_id].pose
        return math.hypot(pose.x - goal.zone.x, pose.y - goal.zone.y)

    goal = min(goals, key=distance)
    return _sweep_to(goal, scene, (goal.zone.x, goal.zone.y))


def _sweep_to(goal: InZone, scene: Scene, target: tuple[float, float]) -> Sweep:
    """Sweep that brings the centre of the goal's block to a point."""
    pose = scene[goal.object_id].pose
    dx, dy = target[0] - pose.x, target[1] - pose.y
    distance = math.hypot(dx, dy)
    if distance == 0:
        raise OracleError(f"object {goal.object_id} is at its target already.")
    ux, uy = dx / distance, dy / distance
    start = (pose.x - STANDOFF_M * ux, pose.y - STANDOFF_M * uy)
    return Sweep(goal, start, (target[0] + SHORTFALL_M * ux, target[1] + SHORTFALL_M * uy))
