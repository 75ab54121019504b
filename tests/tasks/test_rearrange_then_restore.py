"""Goals and outcomes of `rearrange_then_restore`; its scenes are those of `rearrange`."""

import itertools

import numpy as np
import pytest

from openvima.catalog import Assets, pool
from openvima.scene import AtPose, Outcome, Placement, Pose, Problem, in_workspace
from openvima.tasks import Progress, TableSampler, advance, begin, oracle_action, sample_episode, task_spec
from task_cases import assert_uniform, judged

TASK = "rearrange_then_restore"
FAR_AWAY = Pose.planar(0.9, 0.0)


def goals_of(problem: Problem) -> tuple[list[AtPose], list[AtPose]]:
    """Goals to arrange and goals to restore."""
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    num_arranged = problem.stages[0]
    assert sum(problem.stages) == len(goals) == len(problem.goals)
    return goals[:num_arranged], goals[num_arranged:]


def single(*, conflict: bool, **options: object) -> tuple[Problem, Placement, Pose, Placement]:
    """A problem with one object: the object at its start, its target, the distractor."""
    options = {"num_objects": 1, "conflict_rate": float(conflict), **options}
    problem = sample_episode(TASK, seed=2, **options).problem
    (arrange,), _ = goals_of(problem)
    (other,) = (p for p in problem.scene.placements if p.id != arrange.object_id)
    return problem, problem.scene[arrange.object_id], arrange.target, other


def test_scenes_are_those_of_rearrange(assets: Assets) -> None:
    for seed in range(60):
        tables = [
            TableSampler(np.random.default_rng(seed), pool(task, "train"), assets=assets)
            for task in ("rearrange", TASK)
        ]
        first, second = (
            task_spec(task).sample(table) for task, table in zip(("rearrange", TASK), tables, strict=True)
        )
        assert first.scene == second.scene and list(first.goals) == goals_of(second)[0]
        assert first.prompt.images == second.prompt.images
        assert first.prerequisites == second.prerequisites


@pytest.mark.slow
def test_objects_go_back_to_their_starts_in_an_order_of_its_own() -> None:
    orders = []
    for seed in range(600):
        problem = sample_episode(TASK, seed=seed, num_objects=3).problem
        arrange, restore = goals_of(problem)
        assert problem.stages == (3, 3)
        arranged = [goal.object_id for goal in arrange]
        assert all(goal.target == problem.scene[goal.object_id].pose for goal in restore)
        assert all(goal.relative_to is None and in_workspace(goal.target) for goal in problem.goals)
        orders.append(tuple(arranged.index(goal.object_id) for goal in restore))
    assert_uniform(orders, itertools.permutations(range(3)))


def test_everything_there_and_everything_back_takes_two_steps() -> None:
    problem = sample_episode(TASK, seed=0, num_objects=2).problem
    arrange, restore = goals_of(problem)
    there = {goal.object_id: goal.target for goal in arrange}
    back = {goal.object_id: goal.target for goal in restore}
    assert judged(problem, there) == (Progress((2, 3)), Outcome())
    assert judged(problem, there, back)[1].success


def test_going_back_counts_from_the_step_after_the_last_arrangement_on() -> None:
    problem = sample_episode(TASK, seed=0, num_objects=2).problem
    (a, b), _ = goals_of(problem)
    a_back, b_back = ({goal.object_id: problem.scene[goal.object_id].pose} for goal in (a, b))
    there_and_back = judged(problem, {a.object_id: a.target}, {**a_back, b.object_id: b.target})
    assert there_and_back == (Progress((2, 3)), Outcome())
    # Objects taken there and back one by one count: the picture need not exist as a whole.
    steps = ({a.object_id: a.target}, a_back, {b.object_id: b.target}, b_back)
    assert judged(problem, *steps)[1].success


@pytest.mark.parametrize(("distance", "success"), [(0.099, True), (0.101, False)])
def test_an_object_has_to_come_back_near_its_start(distance: float, success: bool) -> None:
    problem, own, target, _ = single(conflict=False)
    inward = 1.0 if own.pose.y < target.y else -1.0
    outcome = judged(problem, {own.id: target}, {own.id: own.pose.moved(dy=inward * distance).rotated(1)})[1]
    assert (outcome.success, outcome.failure) == (success, False)


def test_waiting_at_the_start_restores_nothing() -> None:
    problem, own, target, distractor = single(conflict=True)
    parked = problem.prerequisites[0].target
    assert judged(problem, {distractor.id: parked}, {}, {own.id: target}) == (Progress((1,)), Outcome())


def test_a_parked_distractor_is_left_where_it_is() -> None:
    problem, own, target, distractor = single(conflict=True)
    park, arrange, restore = (
        {distractor.id: problem.prerequisites[0].target},
        {own.id: target},
        {own.id: own.pose},
    )
    assert judged(problem, park, arrange, restore)[1].success
    outcome = judged(problem, park, arrange, {distractor.id: distractor.pose}, restore)[1]
    assert outcome.failure and "is within 0.1 m of the target of" in outcome.reason


def test_an_object_on_top_of_the_distractor_counts_only_if_that_is_moved_later() -> None:
    problem, own, target, distractor = single(conflict=True)
    on_top, restore = {own.id: target}, {own.id: own.pose}
    assert judged(problem, on_top) == (Progress((1,)), Outcome())
    assert judged(problem, on_top, restore)[1].failure
    assert judged(problem, on_top, {distractor.id: FAR_AWAY}, restore)[1].success


@pytest.mark.parametrize(("distance", "failure"), [(0.099, True), (0.101, False)])
def test_at_the_end_a_distractor_must_be_away_from_the_start_as_well(distance: float, failure: bool) -> None:
    problem, own, target, distractor = single(conflict=False)
    inward = 1.0 if own.pose.y < 0 else -1.0
    moved = {own.id: target, distractor.id: own.pose.moved(dy=inward * distance)}
    outcome = judged(problem, moved, {own.id: own.pose})[1]
    assert (outcome.failure, outcome.success) == (failure, not failure)


def test_objects_must_stay_until_they_are_restored() -> None:
    problem = sample_episode(TASK, seed=0, num_objects=2).problem
    (a, b), _ = goals_of(problem)
    arranged = {a.object_id: a.target, b.object_id: b.target}
    assert judged(problem, {a.object_id: FAR_AWAY})[1].failure
    assert judged(problem, arranged, {a.object_id: FAR_AWAY})[1].failure
    restored = {a.object_id: problem.scene[a.object_id].pose}
    assert judged(problem, arranged, restored, {a.object_id: FAR_AWAY})[1] == Outcome()


def test_distractors_start_and_park_away_from_targets_and_starts() -> None:
    for seed in range(500):
        problem = sample_episode(TASK, seed=seed, num_objects=1).problem
        (arrange,), (restore,) = goals_of(problem)
        (other,) = (p for p in problem.scene.placements if p.id != arrange.object_id)
        assert other.pose.planar_distance(restore.target) >= 0.1
        if problem.prerequisites:
            parking = problem.prerequisites[0].target
            assert min(parking.planar_distance(goal.target) for goal in problem.goals) >= 0.1
        else:
            assert other.pose.planar_distance(arrange.target) >= 0.1


def test_the_distractor_can_be_asked_back_too() -> None:
    problem, own, target, distractor = single(conflict=True, restore_distractor=True)
    park = {distractor.id: problem.prerequisites[0].target}
    arrange, restore, back = {own.id: target}, {own.id: own.pose}, {distractor.id: distractor.pose}
    assert judged(problem, park, arrange, restore)[1] == Outcome()
    assert judged(problem, park, arrange, restore, back)[1].success
    assert judged(problem, park, arrange, back, restore)[1].success
    on_top = judged(problem, arrange)[1]
    assert on_top.failure and "is within 0.1 m of the target of" in on_top.reason


def test_a_distractor_that_was_never_in_the_way_has_to_stay_when_asked_back() -> None:
    problem, own, target, distractor = single(conflict=False, restore_distractor=True)
    arrange, restore = {own.id: target}, {own.id: own.pose}
    assert judged(problem, arrange, restore)[1].success
    inward = 0.15 if distractor.pose.y < 0 else -0.15
    elsewhere = {distractor.id: distractor.pose.moved(dy=inward)}
    assert judged(problem, elsewhere, arrange, restore)[1] == Outcome()
    assert judged(problem, {distractor.id: FAR_AWAY})[1].failure


def test_asking_the_distractor_back_changes_no_scene() -> None:
    for seed in range(30):
        default, strict = (
            sample_episode(TASK, seed=seed, restore_distractor=word).problem for word in (False, True)
        )
        assert default.scene == strict.scene and default.prompt == strict.prompt
        assert strict.goals[: len(default.goals)] == default.goals


@pytest.mark.parametrize(
    ("options", "num_steps"),
    [
        ({"num_objects": 1, "conflict_rate": 0}, 2),
        ({"num_objects": 1, "conflict_rate": 1}, 3),
        ({"num_objects": 1, "conflict_rate": 1, "restore_distractor": True}, 4),
        ({"num_objects": 2}, 4),
        ({"num_objects": 3}, 6),
    ],
)
def test_the_oracle_takes_the_shortest_way(
    options: dict[str, object], num_steps: int, assets: Assets
) -> None:
    episode = sample_episode(TASK, seed=5, **options)
    problem, scene = episode.problem, episode.problem.scene
    progress, outcome, rng = begin(problem), Outcome(), np.random.default_rng(0)
    for _ in range(num_steps):
        assert not outcome.is_over
        decision = oracle_action(problem, progress, scene, assets=assets, rng=rng)
        waiting = [problem.goals[index] for index in progress.open_goals]
        goal = next(
            g for g in (*problem.prerequisites, *waiting) if not g.is_met(scene) and isinstance(g, AtPose)
        )
        assert decision.pick_id == goal.object_id
        scene = scene.with_poses({goal.object_id: goal.target})
        progress, outcome = advance(problem, progress, scene)
    assert outcome.success and num_steps <= episode.oracle_max_steps == 8
