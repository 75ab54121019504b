"""Progress of an episode: goals met, constraints violated, success or failure with its reason."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from openvima.scene import (
    AtPose,
    DistractorsApart,
    EveryStepCounts,
    InOrder,
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
    """Open goals, and a permanent violation.

    Args:
        open_goals: Indices into `problem.goals` of the open ones, ascending. A goal once met stays met.
        violation: Empty, or one sentence on a constraint violated during motion.
    """

    open_goals: tuple[int, ...]
    violation: str = ""


def begin(problem: Problem) -> Progress:
    """Return the progress at the start: all goals open, no violation."""
    return Progress(tuple(range(len(problem.goals))))


def needs_monitoring(problem: Problem) -> bool:
    """Whether a constraint must be checked while objects move."""
    return any(isinstance(constraint, NeverTouches) for constraint in problem.constraints)


def monitor(problem: Problem, progress: Progress, scene: Scene) -> Progress:
    """Check the constraints that hold while objects move.

    Args:
        problem: The episode's problem.
        progress: Progress so far.
        scene: The scene during a step.

    Returns:
        The progress, with the first violation.
    """
    if progress.violation:
        return progress
    for constraint in problem.constraints:
        if isinstance(constraint, NeverTouches):
            object_id = constraint.touching(scene)
            if object_id is not None:
                return replace(
                    progress, violation=f"{_describe(scene, object_id)} touched the {constraint.name}"
                )
    return progress


def advance(problem: Problem, progress: Progress, scene: Scene) -> tuple[Progress, Outcome]:
    """Evaluate goals and constraints after a step.

    The order of the checks is part of the benchmark: constraints come before goals, so an object put into its
    base on top of a distractor is a failure. A problem without goals never succeeds; it ends by a violated
    constraint or at the step limit.

    Args:
        problem: The episode's problem.
        progress: Progress so far, including `monitor` during the step.
        scene: The scene at rest.

    Returns:
        The new progress and the outcome.
    """
    progress = monitor(problem, progress, scene)
    open_before = progress.open_goals
    progress = replace(progress, open_goals=_still_open(problem, open_before, scene))
    return progress, _outcome(problem, open_before, progress, scene)


def _still_open(problem: Problem, open_goals: tuple[int, ...], scene: Scene) -> tuple[int, ...]:
    stage = problem.stage_of(open_goals[0]) if open_goals else range(0)
    return tuple(i for i in open_goals if i not in stage or not problem.goals[i].is_met(scene))


def _outcome(problem: Problem, open_before: tuple[int, ...], progress: Progress, scene: Scene) -> Outcome:
    reason = progress.violation or _disturbance(problem, open_before, progress, scene)
    if reason:
        return Outcome(failure=True, reason=reason)
    if not problem.goals:  # nothing to fulfil: only the step limit ends the episode
        return Outcome()
    num_met = len(problem.goals) - len(progress.open_goals)
    num_required = len(problem.goals) if problem.num_required is None else problem.num_required
    if num_met == num_required:
        return Outcome(
            success=True, reason="all goals are met" if not progress.open_goals else _count(num_met)
        )
    if num_met > num_required:
        return Outcome(failure=True, reason=f"{_count(num_met)} instead of {num_required}")
    reason = _wasted_step(problem, open_before, progress, scene) or _left_workspace(problem, progress, scene)
    return Outcome(failure=True, reason=reason) if reason else Outcome()


def _disturbance(problem: Problem, open_before: tuple[int, ...], progress: Progress, scene: Scene) -> str:
    """One sentence on the first constraint that the scene at rest violates, or an empty string."""
    for constraint in problem.constraints:
        reason = ""
        if isinstance(constraint, DistractorsApart):
            concerned = range(len(problem.goals)) if constraint.goals is None else constraint.goals
            if not constraint.at_end or _were_completed(concerned, open_before, progress):
                reason = _distractor_too_near(problem, constraint.object_ids, concerned, scene)
        elif isinstance(constraint, ZoneKeptClear):
            reason = _distractor_in_zone(constraint, scene)
        elif isinstance(constraint, InOrder):
            reason = _out_of_order(problem, constraint, progress, scene)
        if reason:
            return reason
    return ""


def _were_completed(goals: Iterable[int], open_before: tuple[int, ...], progress: Progress) -> bool:
    """Whether this step fulfilled the last of these goals."""
    were_open = [index for index in goals if index in open_before]
    return bool(were_open) and not any(index in progress.open_goals for index in were_open)


def _distractor_too_near(
    problem: Problem, object_ids: Iterable[int], goal_indices: Iterable[int], scene: Scene
) -> str:
    goals = [goal for index in goal_indices if isinstance(goal := problem.goals[index], AtPose)]
    for object_id in object_ids:
        pose, distractor = scene[object_id].pose, f"distractor {_describe(scene, object_id)}"
        for goal in goals:
            reach, moved = goal.tolerance.position_m, _describe(scene, goal.object_id)
            if pose.planar_distance(goal.target) < reach:
                return f"{distractor} is within {reach:g} m of the target of {moved}"
            if goal.tolerance.accepts(scene[goal.object_id].pose, pose, goal.symmetry_rad):
                return f"{moved} is where {distractor} is"
    return ""


def _distractor_in_zone(constraint: ZoneKeptClear, scene: Scene) -> str:
    for object_id in constraint.object_ids:
        if any(constraint.zone.contains(point) for point in block_points(scene[object_id].pose)):
            return f"distractor {_describe(scene, object_id)} is in the goal zone"
    return ""


def _out_of_order(problem: Problem, constraint: InOrder, progress: Progress, scene: Scene) -> str:
    for index in constraint.goals:
        has_to_wait = bool(progress.open_goals) and progress.open_goals[0] < index
        goal = problem.goals[index]
        if has_to_wait and (index not in progress.open_goals or goal.is_met(scene)):
            awaited = _describe(scene, problem.goals[progress.open_goals[0]].object_id)
            moved = _describe(scene, goal.object_id)
            return (
                f"{moved} is where it belongs later" if moved == awaited else f"{moved} came before {awaited}"
            )
    return ""


def _wasted_step(problem: Problem, open_before: tuple[int, ...], progress: Progress, scene: Scene) -> str:
    if EveryStepCounts() not in problem.constraints or progress.open_goals != open_before:
        return ""
    awaited = problem.goals[open_before[0]].object_id
    return f"the step did not bring {_describe(scene, awaited)} to where it had to go next"


def _left_workspace(problem: Problem, progress: Progress, scene: Scene) -> str:
    for index in progress.open_goals:
        object_id = problem.goals[index].object_id
        if not in_workspace(scene[object_id].pose):
            return f"{_describe(scene, object_id)} left the workspace"
    return ""


def _count(num_met: int) -> str:
    return "1 goal is met" if num_met == 1 else f"{num_met} goals are met"


def _describe(scene: Scene, object_id: int) -> str:
    placement = scene[object_id]
    return f"object {object_id} ({placement.texture} {placement.object})"
