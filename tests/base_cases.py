"""Hand-made final states for the tasks that put one object into one base."""

import math

from openvima.scene import AtPose, DistractorsApart, Outcome, Placement, Pose, Problem, in_workspace
from openvima.tasks import advance, begin


def roles(problem: Problem) -> tuple[Placement, Placement, list[Placement]]:
    """Target, base and distractors."""
    (goal,) = problem.goals
    (constraint,) = problem.constraints
    assert isinstance(goal, AtPose) and goal.relative_to is not None
    assert isinstance(constraint, DistractorsApart)
    scene = problem.scene
    return scene[goal.object_id], scene[goal.relative_to], [scene[i] for i in constraint.object_ids]


def roles_with_twins(problem: Problem) -> tuple[Placement, Placement, Placement, list[Placement]]:
    """Target, base, the other object of the target's shape, and the rest."""
    target, base, distractors = roles(problem)
    (twin,) = [distractor for distractor in distractors if distractor.object == target.object]
    return target, base, twin, [distractor for distractor in distractors if distractor is not twin]


def judged(problem: Problem, moved: dict[int, Pose]) -> Outcome:
    """Outcome of a first step that leaves these objects there."""
    return advance(problem, begin(problem), problem.scene.with_poses(moved))[1]


def beside(problem: Problem, anchor: Pose, distance_m: float, *, moved_id: int) -> Pose:
    """The pose at a distance from another that is farthest from all objects but the one to be moved there."""
    angles = [math.radians(degrees) for degrees in range(360)]
    poses = [anchor.moved(distance_m * math.cos(angle), distance_m * math.sin(angle)) for angle in angles]
    others = [p.pose for p in problem.scene.placements if p.id != moved_id and p.pose != anchor]
    return max(filter(in_workspace, poses), key=lambda pose: min(map(pose.planar_distance, others)))


def assert_judged_at_its_limits(problem: Problem) -> None:
    """Both sides of every limit, for the target and for each distractor."""
    target, base, distractors = roles(problem)
    near, far = (beside(problem, base.pose, d, moved_id=target.id) for d in (0.099, 0.101))
    assert judged(problem, {}) == Outcome()
    assert judged(problem, {target.id: near}).success
    assert judged(problem, {target.id: near.rotated(2.0).moved(dz=0.1)}).success  # any heading and height
    assert judged(problem, {target.id: far}) == Outcome()
    outside = [Pose.planar(0.751, y) for y in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    lost_at = max(outside, key=lambda pose: min(pose.planar_distance(d.pose) for d in distractors))
    lost = judged(problem, {target.id: lost_at})
    assert lost.failure and "left the workspace" in lost.reason, lost
    for distractor in distractors:
        near, far = (beside(problem, base.pose, d, moved_id=distractor.id) for d in (0.099, 0.101))
        assert "of the target of" in judged(problem, {distractor.id: near}).reason
        assert judged(problem, {distractor.id: near}).failure
        assert judged(problem, {distractor.id: far}) == Outcome()
        touching = beside(problem, target.pose, 0.09, moved_id=distractor.id)
        assert judged(problem, {distractor.id: touching}).failure
        both = {target.id: base.pose, distractor.id: near}
        assert judged(problem, both).failure  # what is spoilt counts before what is reached
        assert not judged(problem, {distractor.id: Pose.planar(0.9, 0.0)}).failure
