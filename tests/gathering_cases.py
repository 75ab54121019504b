"""Who is who in the tasks that gather objects in a base."""

from openvima.scene import AtPose, DistractorsApart, Placement, Problem


def roles(problem: Problem) -> tuple[Placement, list[Placement], list[Placement]]:
    """Base, objects that belong into it, distractors."""
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    (constraint,) = problem.constraints
    (base_id,) = {goal.relative_to for goal in goals}
    assert isinstance(constraint, DistractorsApart) and base_id is not None
    scene = problem.scene
    dragged = [scene[goal.object_id] for goal in goals]
    assert all(goal.target == scene[base_id].pose for goal in goals)
    return scene[base_id], dragged, [scene[object_id] for object_id in constraint.object_ids]


def tolerance_m(problem: Problem) -> float:
    """The distance from the base's origin that all goals allow."""
    (tolerance,) = {goal.tolerance for goal in problem.goals if isinstance(goal, AtPose)}
    assert tolerance.yaw_rad is None
    return tolerance.position_m
