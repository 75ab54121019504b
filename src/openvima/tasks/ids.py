"""Object ids independent of roles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from openvima.scene import Condition, PhotoImage, Placement, Problem, Prompt, PromptFill, Scene, SceneImage
from openvima.scene.goal import (
    OracleMove,
    distance_to,
    is_condition,
    is_monitored,
    object_of,
    oracle_move,
    unmet_reason,
)


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
        goals=tuple(_renumbered(goal, new_of) for goal in problem.goals),
        constraints=tuple(_renumbered(constraint, new_of) for constraint in problem.constraints),
        prerequisites=tuple(_renumbered(goal, new_of) for goal in problem.prerequisites),
    )


def _permutation(ids: Sequence[int], rng: np.random.Generator) -> dict[int, int]:
    return dict(zip(ids, rng.permutation(ids).tolist(), strict=True))


def _renumbered_scene(scene: Scene, new_of: dict[int, int]) -> Scene:
    placements = (replace(placement, id=new_of[placement.id]) for placement in scene.placements)
    return replace(scene, placements=tuple(sorted(placements, key=lambda placement: placement.id)))


def _renumbered(condition: Any, new_of: dict[int, int]) -> Any:  # Any: a goal gives a goal
    """Return a goal or constraint for new ids."""
    if hasattr(condition, "renumbered"):
        return condition.renumbered(new_of)
    return RenumberedCondition(condition, new_of) if is_condition(condition) else condition


@dataclass(frozen=True, slots=True)
class RenumberedCondition:
    """A condition without `renumbered`; it sees scenes with the ids with which it was made.

    Args:
        condition: The goal or constraint.
        new_of: Old id to new id.
    """

    condition: Condition
    new_of: Mapping[int, int]

    @property
    def object_id(self) -> int | None:
        """New id of the object that the condition is about."""
        old_id = object_of(self.condition)
        return None if old_id is None else self.new_of[old_id]

    @property
    def monitored(self) -> bool:
        """Whether it is tested during motion too."""
        return is_monitored(self.condition)

    def is_met(self, scene: Scene) -> bool:
        """Whether the condition is met."""
        return self.condition.is_met(self._as_made(scene))

    def reason(self, scene: Scene) -> str:
        """Why the condition is not met."""
        return unmet_reason(self.condition, self._as_made(scene))

    def distance(self, scene: Scene) -> tuple[float, float] | None:
        """Return how far its object is from meeting it, in metres and radians; None if it does not say."""
        return distance_to(self.condition, self._as_made(scene))

    def oracle_move(self, scene: Scene) -> OracleMove | None:
        """Return what the oracle pursues, with the new ids."""
        move = oracle_move(self.condition, self._as_made(scene))
        return None if move is None else move.renumbered(self.new_of)

    def renumbered(self, new_of: Mapping[int, int]) -> "RenumberedCondition":
        """Return the condition for other ids."""
        return RenumberedCondition(self.condition, {old: new_of[new] for old, new in self.new_of.items()})

    def _as_made(self, scene: Scene) -> Scene:
        return _renumbered_scene(scene, {new: old for old, new in self.new_of.items()})


def _renumbered_image(fill: PromptFill, new_of: dict[int, int], new_in_prompt: dict[int, int]) -> PromptFill:
    if isinstance(fill, SceneImage):
        return SceneImage(_renumbered_scene(fill.scene, new_in_prompt))
    if isinstance(fill, PhotoImage):
        return fill
    placement: Placement = fill.placement
    return replace(fill, placement=replace(placement, id=new_of.get(placement.id, placement.id)))
