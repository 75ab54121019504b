"""Object ids independent of roles."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np

from openvima.scene import (
    Constraint,
    EveryStepCounts,
    Goal,
    InOrder,
    NeverTouches,
    Placement,
    Problem,
    Prompt,
    PromptFill,
    Scene,
    SceneImage,
)

AnyGoal = TypeVar("AnyGoal", bound=Goal)


def shuffled_ids(problem: Problem, rng: np.random.Generator) -> Problem:
    """Permute the ids of a problem's objects.

    Tasks place objects in a fixed order of roles, so their order would reveal the target.

    Args:
        problem: The problem with ids in the order of placing.
        rng: Generator of the permutation.

    Returns:
        The same problem with new ids in scene, goals, constraints and prompt images.
    """
    new_of = _permutation([placement.id for placement in problem.scene.placements], rng)
    prompt_ids = {
        p.id
        for _, fill in problem.prompt.images
        if isinstance(fill, SceneImage)
        for p in fill.scene.placements
    }
    new_in_prompt = _permutation(sorted(prompt_ids), rng)  # one for all frames
    images = tuple(
        (name, _renumbered_image(fill, new_of, new_in_prompt)) for name, fill in problem.prompt.images
    )
    return replace(
        problem,
        scene=_renumbered_scene(problem.scene, new_of),
        prompt=Prompt(problem.prompt.text, images),
        goals=tuple(_renumbered_goal(goal, new_of) for goal in problem.goals),
        constraints=tuple(_renumbered_constraint(constraint, new_of) for constraint in problem.constraints),
        prerequisites=tuple(_renumbered_goal(goal, new_of) for goal in problem.prerequisites),
    )


def _permutation(ids: Sequence[int], rng: np.random.Generator) -> dict[int, int]:
    return dict(zip(ids, rng.permutation(ids).tolist(), strict=True))


def _renumbered_scene(scene: Scene, new_of: dict[int, int]) -> Scene:
    placements = (replace(placement, id=new_of[placement.id]) for placement in scene.placements)
    return replace(scene, placements=tuple(sorted(placements, key=lambda placement: placement.id)))


def _renumbered_goal(goal: AnyGoal, new_of: dict[int, int]) -> AnyGoal:
    relative_to = None if goal.relative_to is None else new_of[goal.relative_to]
    return replace(goal, object_id=new_of[goal.object_id], relative_to=relative_to)


def _renumbered_constraint(constraint: Constraint, new_of: dict[int, int]) -> Constraint:
    if isinstance(constraint, InOrder | EveryStepCounts):
        return constraint
    object_ids = tuple(sorted(new_of[object_id] for object_id in constraint.object_ids))
    if isinstance(constraint, NeverTouches):
        return NeverTouches(object_ids, constraint.zone, constraint.name)
    return replace(constraint, object_ids=object_ids)


def _renumbered_image(fill: PromptFill, new_of: dict[int, int], new_in_prompt: dict[int, int]) -> PromptFill:
    if isinstance(fill, SceneImage):
        return SceneImage(_renumbered_scene(fill.scene, new_in_prompt))
    placement: Placement = fill.placement
    return replace(fill, placement=replace(placement, id=new_of.get(placement.id, placement.id)))
