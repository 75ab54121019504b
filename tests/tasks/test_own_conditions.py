"""Goals and constraints of users: anything with `is_met(scene)`."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from openvima.catalog import load_assets
from openvima.env import TabletopEnv
from openvima.errors import OracleError, SceneError
from openvima.scene import (
    AtPose,
    Episode,
    Goal,
    Outcome,
    Placement,
    Pose,
    Problem,
    Prompt,
    Scene,
    StepContext,
    Tolerance,
)
from openvima.tasks import advance, begin, monitor, oracle_action
from openvima.tasks.goals import needs_monitoring
from openvima.tasks.sampling import RenumberedCondition, shuffle_ids
from task_cases import judge_step

HEART, STAR = 5, 6


@dataclass(frozen=True)
class LeftOf:
    """Only what a goal must have."""

    moved: int
    other: int

    def is_met(self, scene: Scene) -> bool:
        return scene[self.moved].pose.y > scene[self.other].pose.y


@dataclass(frozen=True)
class LeftOfWithMove(LeftOf):
    """All that the environment can use."""

    @property
    def object_id(self) -> int:
        return self.moved

    def oracle_move(self, scene: Scene) -> AtPose:
        pose = scene[self.other].pose
        return AtPose(self.moved, Pose.planar(pose.x, pose.y + 0.2), Tolerance(0.02))


class Stays:
    """A constraint that is tested during motion."""

    monitored = True

    def is_met(self, scene: Scene) -> bool:
        return scene[STAR].pose.y < 0.05

    def reason(self, scene: Scene) -> str:
        return f"{scene.describe(STAR)} was moved"


def table() -> Scene:
    places = {HEART: ("heart", -0.2), STAR: ("star", 0.0)}
    return Scene(
        tuple(
            Placement(i, name, "red", (0.144, 0.144, 0.036), Pose.planar(0.5, y))
            for i, (name, y) in places.items()
        )
    )


def problem(goal: Goal, **changes: object) -> Problem:
    return replace(Problem(table(), Prompt("", ()), (goal,)), **changes)


def after(asked: Problem, heart_y: float) -> Outcome:
    return judge_step(asked, {HEART: Pose.planar(0.5, heart_y)})


def test_a_predicate_is_a_goal_or_a_constraint() -> None:
    asked = problem(LeftOf(HEART, STAR))
    assert after(asked, -0.1) == Outcome()
    assert after(asked, 0.1).success
    asked = replace(asked, constraints=(LeftOf(STAR, HEART),))
    assert after(asked, 0.1) == Outcome(failure=True, reason="LeftOf is violated")


def test_an_object_that_a_goal_names_must_stay_in_the_workspace() -> None:
    assert after(problem(LeftOf(HEART, STAR)), -0.6) == Outcome()
    lost = after(problem(LeftOfWithMove(HEART, STAR)), -0.6)
    assert lost == Outcome(failure=True, reason="object 5 (red heart) left the workspace")


def test_a_constraint_may_depend_on_the_goals() -> None:
    class TooEarly:
        def violation(self, context: StepContext) -> str:
            return f"{context.describe(0)} came too early" if not context.open_goals else ""

    asked = problem(LeftOf(HEART, STAR), constraints=(TooEarly(),))
    for same in (asked, replace(asked, goals=(RenumberedCondition(LeftOf(5, 6), {5: 5, 6: 6}),))):
        assert after(same, 0.1).reason == "goal LeftOf came too early"
        assert after(same, -0.1) == Outcome()


def test_a_monitored_constraint_is_tested_during_motion() -> None:
    asked = problem(LeftOf(HEART, STAR), constraints=(Stays(),))
    assert needs_monitoring(asked) and not needs_monitoring(problem(LeftOf(HEART, STAR)))
    moving = asked.scene.with_poses({STAR: Pose.planar(0.5, 0.1)})
    progress = monitor(asked, begin(asked), moving)
    assert progress.violation == "object 6 (red star) was moved"
    assert advance(asked, progress, asked.scene)[1].failure  # also after it came back


@pytest.mark.parametrize("changes", [{"goals": ("heart",)}, {"constraints": (3,)}])
def test_what_cannot_be_tested_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(SceneError, match=r"it must have a method is_met\(scene\)"):
        problem(LeftOf(HEART, STAR), **changes)


def test_a_goal_follows_its_objects_when_ids_are_permuted() -> None:
    asked = problem(LeftOfWithMove(HEART, STAR), constraints=(Stays(),))
    seeds = (np.random.default_rng(seed) for seed in range(20))
    swapped = next(p for rng in seeds if (p := shuffle_ids(asked, rng)).scene[STAR].object == "heart")
    goal, stays = swapped.goals[0], swapped.constraints[0]
    assert goal.object_id == STAR and stays.monitored
    above = swapped.scene.with_poses({STAR: Pose.planar(0.5, 0.1)})
    assert goal.is_met(above) and not goal.is_met(swapped.scene)
    assert goal.oracle_move(swapped.scene).object_id == STAR
    moved = swapped.scene.with_poses({HEART: Pose.planar(0.5, 0.3)})  # the star, by its new id
    assert not stays.is_met(moved) and "star" in stays.reason(moved)


def test_the_oracle_pursues_the_move_of_a_goal() -> None:
    env = TabletopEnv("rotate")
    asked = problem(LeftOfWithMove(HEART, STAR))
    env.reset(options={"episode": Episode("rotate", "train", "user", 0, asked, 1, 3)})
    *_, info = env.step(env.oracle_decision().action)
    assert info["success"]


def test_the_oracle_names_a_goal_without_a_move() -> None:
    asked = problem(LeftOf(HEART, STAR))
    rng = np.random.default_rng(0)
    with pytest.raises(OracleError, match=r"LeftOf\(moved=5, other=6\).* no oracle_move"):
        oracle_action(asked, begin(asked), asked.scene, assets=load_assets(), rng=rng)
