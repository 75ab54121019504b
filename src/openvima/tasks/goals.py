"""How an episode stands: goals met so far, constraints broken, success or failure and why."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from openvima.scene import (
    AtPose,
    DistractorsApart,
    NeverTouches,
    Outcome,
    Problem,
    Scene,
    ZoneKeptClear,
    block_points,
    in_workspace,
)


@dataclass(frozen=True, slots=True)
class Progress:
    """What has been achieved and what has been spoilt for good.

    Args:
        open_goals: Indices into `problem.goals` of those not met yet, ascending. A goal once met stays met.
        violation: Empty, or one sentence on a constraint that was broken while things moved.
    """

    open_goals: tuple[int, ...]
    violation: str = ""


def begin(problem: Problem) -> Progress:
    """Return the progress at the start: all goals open, nothing broken."""
    return Progress(tuple(range(len(problem.goals))))


def watch(problem: Problem, progress: Progress, scene: Scene) -> Progress:
    """Note broken constraints while objects move.

    Args:
        problem: The episode's problem.
        progress: How things stood before.
        scene: Where the objects are now, in the middle of a step.

    Returns:
        The same progress, or one with the first violation written into it.
    """
    if progress.violation:
        return progress
    for constraint in problem.constraints:
        if isinstance(constraint, NeverTouches):
            object_id = constraint.touching(scene)
            if object_id is not None:
                return replace(
                    progress, violation=f"{_called(scene, object_id)} touched the {constraint.name}"
                )
    return progress


def advance(problem: Problem, progress: Progress, scene: Scene) -> tuple[Progress, Outcome]:
    """Judge the scene after a step.

    The order of the checks is part of the benchmark: what was broken comes before what was reached, so an
    object put into its base on top of a distractor is a failure.

    Args:
        problem: The episode's problem.
        progress: How things stood before, with what `watch` noted during the step.
        scene: Where the objects came to rest.

    Returns:
        The new progress and the outcome.
    """
    progress = watch(problem, progress, scene)
    progress = replace(progress, open_goals=_still_open(problem, progress.open_goals, scene))
    return progress, _outcome(problem, progress, scene)


def _still_open(problem: Problem, open_goals: tuple[int, ...], scene: Scene) -> tuple[int, ...]:
    if problem.goal_order == "sequential":
        met = bool(open_goals) and problem.goals[open_goals[0]].is_met(scene)
        return open_goals[1:] if met else open_goals  # at most one a step
    return tuple(index for index in open_goals if not problem.goals[index].is_met(scene))


def _outcome(problem: Problem, progress: Progress, scene: Scene) -> Outcome:
    reason = progress.violation or _disturbance(problem, scene)
    if reason:
        return Outcome(failure=True, reason=reason)
    num_met = len(problem.goals) - len(progress.open_goals)
    num_required = len(problem.goals) if problem.num_required is None else problem.num_required
    if num_met == num_required:
        return Outcome(
            success=True, reason="all goals are met" if not progress.open_goals else _count(num_met)
        )
    if num_met > num_required:
        return Outcome(failure=True, reason=f"{_count(num_met)} instead of {num_required}")
    left = _left_workspace(problem, progress, scene)
    return Outcome(failure=True, reason=left) if left else Outcome()


def _disturbance(problem: Problem, scene: Scene) -> str:
    """One sentence on the first constraint that the scene at rest breaks, or nothing."""
    for constraint in problem.constraints:
        if isinstance(constraint, DistractorsApart):
            reason = _distractor_too_near(problem, constraint.object_ids, scene)
        elif isinstance(constraint, ZoneKeptClear):
            reason = _distractor_in_zone(constraint, scene)
        else:
            reason = ""  # latched by `watch`
        if reason:
            return reason
    return ""


def _distractor_too_near(problem: Problem, object_ids: Iterable[int], scene: Scene) -> str:
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    for object_id in object_ids:
        pose, distractor = scene[object_id].pose, f"distractor {_called(scene, object_id)}"
        for goal in goals:
            reach, moved = goal.tolerance.position_m, _called(scene, goal.object_id)
            if pose.planar_distance(goal.target) < reach:
                return f"{distractor} is within {reach:g} m of the target of {moved}"
            if goal.tolerance.accepts(scene[goal.object_id].pose, pose, goal.symmetry_rad):
                return f"{moved} is where {distractor} is"
    return ""


def _distractor_in_zone(constraint: ZoneKeptClear, scene: Scene) -> str:
    for object_id in constraint.object_ids:
        if any(constraint.zone.contains(point) for point in block_points(scene[object_id].pose)):
            return f"distractor {_called(scene, object_id)} is in the goal zone"
    return ""


def _left_workspace(problem: Problem, progress: Progress, scene: Scene) -> str:
    awaited = progress.open_goals[:1] if problem.goal_order == "sequential" else progress.open_goals
    for index in awaited:
        object_id = problem.goals[index].object_id
        if not in_workspace(scene[object_id].pose):
            return f"{_called(scene, object_id)} left the workspace"
    return ""


def _count(num_met: int) -> str:
    return "1 goal is met" if num_met == 1 else f"{num_met} goals are met"


def _called(scene: Scene, object_id: int) -> str:
    placement = scene[object_id]
    return f"object {object_id} ({placement.texture} {placement.object})"
