"""Object ids that say nothing about an object's role."""

from dataclasses import replace

import numpy as np

from openvima.scene import (
    Constraint,
    Goal,
    NeverTouches,
    ObjectImage,
    Placement,
    Problem,
    Prompt,
    PromptFill,
    Scene,
)


def shuffled_ids(problem: Problem, rng: np.random.Generator) -> Problem:
    """Deal the ids of a problem's objects out anew.

    Tasks place objects in a fixed order of roles, so ids in that order would point at the target.

    Args:
        problem: The problem with ids in the order of placing.
        rng: Draws one permutation.

    Returns:
        The same problem under the new ids: scene, goals, constraints and prompt images agree.
    """
    old = [placement.id for placement in problem.scene.placements]
    new_of = dict(zip(old, rng.permutation(old).tolist(), strict=True))
    placements = sorted((replace(p, id=new_of[p.id]) for p in problem.scene.placements), key=lambda p: p.id)
    images = tuple((name, _renumbered_image(fill, new_of)) for name, fill in problem.prompt.images)
    return replace(
        problem,
        scene=Scene(tuple(placements), problem.scene.end_effector),
        prompt=Prompt(problem.prompt.text, images),
        goals=tuple(_renumbered_goal(goal, new_of) for goal in problem.goals),
        constraints=tuple(_renumbered_constraint(constraint, new_of) for constraint in problem.constraints),
    )


def _renumbered_goal(goal: Goal, new_of: dict[int, int]) -> Goal:
    relative_to = None if goal.relative_to is None else new_of[goal.relative_to]
    return replace(goal, object_id=new_of[goal.object_id], relative_to=relative_to)


def _renumbered_constraint(constraint: Constraint, new_of: dict[int, int]) -> Constraint:
    object_ids = tuple(sorted(new_of[object_id] for object_id in constraint.object_ids))
    if isinstance(constraint, NeverTouches):
        return NeverTouches(object_ids, constraint.zone, constraint.name)
    return replace(constraint, object_ids=object_ids)


def _renumbered_image(fill: PromptFill, new_of: dict[int, int]) -> PromptFill:
    if not isinstance(fill, ObjectImage):
        return fill  # a scene image counts its ids on its own
    placement: Placement = fill.placement
    return replace(fill, placement=replace(placement, id=new_of.get(placement.id, placement.id)))
