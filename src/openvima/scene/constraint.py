"""Constraints: conditions that must hold until the goals are met."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, TypeAlias

from openvima.errors import brief_repr
from openvima.scene.goal import AtPose, Condition, Goal, Zone, block_points, kind_of, object_of
from openvima.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class StepContext:
    """A step, as constraints see it that depend on goals.

    Args:
        goals: All goals of the episode.
        open_before: Indices of the goals that were open before the step, ascending.
        open_goals: Indices of those open after it.
        scene: The scene at rest.
    """

    goals: tuple[Goal, ...]
    open_before: tuple[int, ...]
    open_goals: tuple[int, ...]
    scene: Scene

    __repr__ = brief_repr

    def describe(self, goal_index: int) -> str:
        """Name the object of a goal, or the goal if it names no object."""
        goal = self.goals[goal_index]
        object_id = object_of(goal)
        return f"goal {kind_of(goal)}" if object_id is None else self.scene.describe(object_id)


class StepConstraint(Protocol):
    """A constraint that depends on the goals and their progress; tested after every step.

    One that holds object ids needs `renumbered(new_of)`, which returns the same constraint for other ids:
    sampling permutes ids, and the context has the new ones.
    """

    def violation(self, context: StepContext, /) -> str:
        """Return one sentence on how the step violates the constraint, or an empty string."""
        ...


Constraint: TypeAlias = Condition | StepConstraint
"""A `Condition`, violated where it is not met, or a `StepConstraint`."""


@dataclass(frozen=True, slots=True)
class DistractorsApart:
    """No distractor is near a goal's target, and no goal's object near a distractor.

    Tested after every step, whether the goals are met or not: a distractor within a goal's
    `tolerance.position_m` of its target, or the goal's object matching the distractor's pose within the
    goal's whole tolerance, is a violation. Goals other than `AtPose` do not count.

    Args:
        object_ids: The distractors.
        at_end: Test only once, in the step that fulfils the last of the goals.
        goals: Indices of the goals that count; None: all of the episode.
    """

    object_ids: tuple[int, ...]
    at_end: bool = False
    goals: tuple[int, ...] | None = None

    __repr__ = brief_repr

    def violation(self, context: StepContext) -> str:
        """Say which distractor is where it must not be."""
        concerned = range(len(context.goals)) if self.goals is None else self.goals
        if self.at_end and not _were_completed(concerned, context):
            return ""
        scene = context.scene
        goals = [goal for index in concerned if isinstance(goal := context.goals[index], AtPose)]
        for object_id in self.object_ids:
            pose, distractor = scene[object_id].pose, f"distractor {scene.describe(object_id)}"
            for goal in goals:
                reach, moved = goal.tolerance.position_m, scene.describe(goal.object_id)
                if pose.planar_distance(goal.target) < reach:
                    return f"{distractor} is within {reach:g} m of the target of {moved}"
                if goal.tolerance.accepts(scene[goal.object_id].pose, pose, goal.symmetry_rad):
                    return f"{moved} is where {distractor} is"
        return ""

    def renumbered(self, new_of: Mapping[int, int]) -> "DistractorsApart":
        """Return the constraint for other object ids."""
        return replace(self, object_ids=_renumbered(self.object_ids, new_of))


def _were_completed(goals: Iterable[int], context: StepContext) -> bool:
    """Whether this step fulfilled the last of these goals."""
    were_open = [index for index in goals if index in context.open_before]
    return bool(were_open) and not any(index in context.open_goals for index in were_open)


@dataclass(frozen=True, slots=True)
class ZoneKeptClear:
    """No point of these blocks is in the zone; tested after every step."""

    object_ids: tuple[int, ...]
    zone: Zone

    __repr__ = brief_repr

    def is_met(self, scene: Scene) -> bool:
        """Whether the zone is clear."""
        return _first_in(self.zone, self.object_ids, scene) is None

    def reason(self, scene: Scene) -> str:
        """Name the first block in the zone."""
        object_id = _first_in(self.zone, self.object_ids, scene)
        return "" if object_id is None else f"distractor {scene.describe(object_id)} is in the goal zone"

    def renumbered(self, new_of: Mapping[int, int]) -> "ZoneKeptClear":
        """Return the constraint for other object ids."""
        return replace(self, object_ids=_renumbered(self.object_ids, new_of))


@dataclass(frozen=True, slots=True)
class NeverTouches:
    """No point of these blocks ever enters the zone; tested during motion, and permanent.

    Args:
        object_ids: The blocks.
        zone: The forbidden rectangle.
        name: Name of the zone in the reason of a failure, such as "line".
    """

    monitored: ClassVar[bool] = True

    object_ids: tuple[int, ...]
    zone: Zone
    name: str

    __repr__ = brief_repr

    def is_met(self, scene: Scene) -> bool:
        """Whether no block touches the zone now."""
        return _first_in(self.zone, self.object_ids, scene) is None

    def reason(self, scene: Scene) -> str:
        """Name the first block in the zone."""
        object_id = _first_in(self.zone, self.object_ids, scene)
        return "" if object_id is None else f"{scene.describe(object_id)} touched the {self.name}"

    def renumbered(self, new_of: Mapping[int, int]) -> "NeverTouches":
        """Return the constraint for other object ids."""
        return replace(self, object_ids=_renumbered(self.object_ids, new_of))


@dataclass(frozen=True, slots=True)
class InOrder:
    """None of these goals is fulfilled while an earlier goal of the episode is open; tested after every step.

    Args:
        goals: Indices of the later goals.
    """

    goals: tuple[int, ...]

    __repr__ = brief_repr

    def violation(self, context: StepContext) -> str:
        """Say which object came too early."""
        for index in self.goals:
            has_to_wait = bool(context.open_goals) and context.open_goals[0] < index
            if has_to_wait and (
                index not in context.open_goals or context.goals[index].is_met(context.scene)
            ):
                awaited, moved = context.describe(context.open_goals[0]), context.describe(index)
                is_same = moved == awaited
                return f"{moved} is where it belongs later" if is_same else f"{moved} came before {awaited}"
        return ""


@dataclass(frozen=True, slots=True)
class EveryStepCounts:
    """Each step has to fulfil a goal; the first one that does not ends the episode."""

    def violation(self, context: StepContext) -> str:
        """Say which object the step should have moved."""
        if not context.open_goals or context.open_goals != context.open_before:
            return ""
        awaited = context.describe(context.open_goals[0])
        return f"the step did not bring {awaited} to where it had to go next"


def _first_in(zone: Zone, object_ids: Iterable[int], scene: Scene) -> int | None:
    """Id of the first block with a point in a zone, or None."""
    for object_id in object_ids:
        pose = scene[object_id].pose
        if zone.is_near(pose) and any(zone.contains(point) for point in block_points(pose)):
            return object_id
    return None


def _renumbered(object_ids: Iterable[int], new_of: Mapping[int, int]) -> tuple[int, ...]:
    return tuple(sorted(new_of[object_id] for object_id in object_ids))
