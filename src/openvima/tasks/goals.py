"""Progress of an episode: goals met, constraints violated, success or failure with its reason."""

import math
from dataclasses import dataclass, replace
from typing import cast

from openvima.errors import brief_repr
from openvima.scene import Outcome, Problem, Scene, StepConstraint, StepContext, in_workspace
from openvima.scene.goal import distance_to, is_condition, is_monitored, object_of, unmet_reason

LEVER_M = 0.1  # m per radian, to compare moves with rotations: about the reach of an object


@dataclass(frozen=True, slots=True)
class Progress:
    """Open goals, and a permanent violation.

    Args:
        open_goals: Indices into `problem.goals` of the open ones, ascending. A goal once met stays met.
        violation: Empty, or one sentence on a constraint violated during motion.
    """

    open_goals: tuple[int, ...]
    violation: str = ""

    __repr__ = brief_repr


def begin(problem: Problem) -> Progress:
    """Return the progress at the start: all goals open, no violation."""
    return Progress(tuple(range(len(problem.goals))))


def needs_monitoring(problem: Problem) -> bool:
    """Whether a constraint must be checked while objects move."""
    return any(is_monitored(constraint) for constraint in problem.constraints)


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
        if is_monitored(constraint) and is_condition(constraint) and not constraint.is_met(scene):
            return replace(progress, violation=unmet_reason(constraint, scene))
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
    stage = problem.stage_of(open_before[0]) if open_before else range(0)
    still_open = tuple(i for i in open_before if i not in stage or not problem.goals[i].is_met(scene))
    progress = replace(progress, open_goals=still_open)
    return progress, _outcome(problem, open_before, progress, scene)


def measure(problem: Problem, progress: Progress, scene: Scene) -> dict[str, float]:
    """Return how near the episode is to success, as dense numbers.

    Args:
        problem: The episode's problem.
        progress: The open goals.
        scene: The scene now.

    Returns:
        `goals_met`: fraction of the required goals that are met, 0 … 1, also where more are met than may be;
        0 without goals. `distance_m` and `angle_rad`: how far the nearest of the goals that can be met next
        is from its target. Both are 0 once `goals_met` is 1, and infinite if no goal states a distance
        (unlike NaN equal in equal episodes).
    """
    num_goals = len(problem.goals)
    num_required = num_goals if problem.num_required is None else problem.num_required
    num_met = num_goals - len(progress.open_goals)
    goals_met = min(1.0, num_met / num_required) if num_required else 0.0
    if goals_met == 1.0:
        return {"goals_met": 1.0, "distance_m": 0.0, "angle_rad": 0.0}
    stage = problem.stage_of(progress.open_goals[0]) if progress.open_goals else range(0)
    distances = [distance_to(problem.goals[i], scene) for i in progress.open_goals if i in stage]
    stated = [distance for distance in distances if distance is not None and not math.isnan(sum(distance))]
    distance_m, angle_rad = min(
        stated, key=lambda distance: distance[0] + LEVER_M * distance[1], default=(math.inf, math.inf)
    )
    return {"goals_met": goals_met, "distance_m": distance_m, "angle_rad": angle_rad}


def _outcome(problem: Problem, open_before: tuple[int, ...], progress: Progress, scene: Scene) -> Outcome:
    context = StepContext(problem.goals, open_before, progress.open_goals, scene)
    reason = progress.violation or _first_violation(problem, context)
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
    reason = _left_workspace(problem, progress, scene)
    return Outcome(failure=True, reason=reason) if reason else Outcome()


def _first_violation(problem: Problem, context: StepContext) -> str:
    """One sentence on the first constraint that the step violates, or an empty string."""
    for constraint in problem.constraints:
        reason = ""
        if not is_condition(constraint):
            reason = cast(StepConstraint, constraint).violation(context)  # the only other kind
        elif not is_monitored(constraint) and not constraint.is_met(context.scene):  # `monitor` tests those
            reason = unmet_reason(constraint, context.scene)
        if reason:
            return reason
    return ""


def _left_workspace(problem: Problem, progress: Progress, scene: Scene) -> str:
    for index in progress.open_goals:
        object_id = object_of(problem.goals[index])
        if object_id is not None and not in_workspace(scene[object_id].pose):
            return f"{scene.describe(object_id)} left the workspace"
    return ""


def _count(num_met: int) -> str:
    return "1 goal is met" if num_met == 1 else f"{num_met} goals are met"
