"""Scenes, pictures and outcomes of `rearrange` and `rearrange_then_restore` follow their specification."""

import itertools
from typing import Any

import numpy as np
import pytest

from openvima.catalog import TEXTURE_SETS, Assets, pool
from openvima.scene import AtPose, DistractorsApart, Episode, Outcome, Placement, Pose, Problem, in_workspace
from openvima.tasks import Progress, TableSampler, advance, begin, oracle_action, sample_episode, task_spec
from openvima.tasks.table import is_in_the_way
from task_cases import assert_frequencies, assert_uniform, judged, moves, pictured

TASK = "rearrange"
RESTORE = "rearrange_then_restore"
NUM_EPISODES = 1250
FAR_AWAY = Pose.planar(0.9, 0.0)


def moved(problem: Problem) -> list[tuple[Placement, Pose]]:
    """Each object to move, where it stands, and its target."""
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    assert len(goals) == len(problem.goals)
    return [(problem.scene[goal.object_id], goal.target) for goal in goals]


def distractor_of(problem: Problem) -> Placement | None:
    (constraint,) = problem.constraints
    assert isinstance(constraint, DistractorsApart) and constraint.at_end
    ids = constraint.object_ids
    return problem.scene[ids[0]] if ids else None


def episodes(
    task: str, num_objects: int, count: int = 1, *, conflict: bool | None = None, **options: Any
) -> list[Episode]:
    """The first episodes with so many objects to move, and with a distractor in the way, or not, if asked."""
    sampled = (sample_episode(task, seed=seed, **options) for seed in itertools.count())
    found = (
        episode
        for episode in sampled
        if len(pictured(episode.problem)) == num_objects
        and conflict in (None, bool(episode.problem.prerequisites))
    )
    return list(itertools.islice(found, count))


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, seed=seed).problem for seed in range(NUM_EPISODES)]


@pytest.mark.slow
def test_only_a_single_object_has_a_distractor_and_half_of_these_are_in_its_way(
    problems: list[Problem],
) -> None:
    assert_frequencies((len(p.goals) for p in problems), {1: 0.4, 2: 0.4, 3: 0.2})
    for problem in problems:
        has_distractor = distractor_of(problem) is not None
        assert has_distractor is (len(problem.goals) == 1)
        assert len(problem.scene.placements) == len(problem.goals) + has_distractor
    single = (bool(p.prerequisites) for p in problems if len(p.goals) == 1)
    assert_frequencies(single, {True: 0.5, False: 0.5})
    assert not any(p.prerequisites for p in problems if len(p.goals) > 1)


@pytest.mark.parametrize("level", ["train", "L2", "L3"])
@pytest.mark.slow
def test_a_distractor_has_another_shape_and_any_of_the_49_textures(level: str) -> None:
    distractors = []
    for episode in episodes(TASK, 1, 1000, level=level):
        problem = episode.problem
        ((target, _),), distractor = moved(problem), distractor_of(problem)
        assert distractor is not None and distractor.object != target.object
        assert target.object in pool(TASK, level).dragged_objects
        assert target.texture in pool(TASK, level).dragged_textures
        assert not distractor.fixed
        distractors.append(distractor)
    assert_uniform((d.texture for d in distractors), TEXTURE_SETS["T"])
    assert {d.object for d in distractors} == set(pool(TASK, level).dragged_objects)


def test_distractors_can_be_kept_to_the_textures_of_the_level() -> None:
    for level, textures in (("train", "C1"), ("L2", "C2")):
        for episode in episodes(TASK, 1, 30, level=level, distractor_textures="pool"):
            assert {p.texture for p in episode.problem.scene.placements} <= set(TEXTURE_SETS[textures])


@pytest.mark.slow
def test_nothing_starts_in_the_way_of_a_target(problems: list[Problem]) -> None:
    for problem in problems:
        goals, taken = moved(problem), distractor_of(problem)
        for own, target in goals:
            at_target = own.at(target)
            standing = [placement for placement, _ in goals]
            if taken is not None and not problem.prerequisites:
                standing.append(taken)
            for placement in standing:
                assert not is_in_the_way(placement, at_target)
                assert placement.pose.planar_distance(target) >= 0.1
            if taken is not None:
                assert taken.pose.planar_distance(own.pose) >= 0.1


@pytest.mark.slow
def test_a_distractor_in_the_way_stands_exactly_on_the_target_at_its_own_height(
    problems: list[Problem], assets: Assets
) -> None:
    for problem in problems:
        distractor = distractor_of(problem)
        if distractor is None or not problem.prerequisites:
            continue
        ((own, target),) = moved(problem)
        assert distractor.pose.position[:2] == target.position[:2]
        assert distractor.pose.quaternion == target.quaternion
        assert distractor.pose.z == assets.geometry(distractor.object, distractor.size).rest_z_m
        (parking,) = problem.prerequisites
        assert parking.object_id == distractor.id
        parked = distractor.at(parking.target)
        assert not is_in_the_way(parked, own.at(target))
        assert parked.pose.planar_distance(own.pose) >= 0.11


@pytest.mark.slow
def test_the_picture_shows_the_objects_at_their_targets_and_no_distractor(problems: list[Problem]) -> None:
    for problem in problems:
        shown = {(p.object, p.texture, p.size, p.pose) for p in pictured(problem)}
        assert shown == {(p.object, p.texture, p.size, target) for p, target in moved(problem)}
        assert sorted(p.id for p in pictured(problem)) == list(range(2, 2 + len(problem.goals)))


def single(task: str, *, conflict: bool, **options: Any) -> tuple[Problem, Placement, Pose, Placement, float]:
    """A problem with one object: it at its start, its target, the distractor, which way is inward for it."""
    problem = episodes(task, 1, conflict=conflict, **options)[0].problem
    own, target = moved(problem)[0]
    (other,) = (p for p in problem.scene.placements if p.id != own.id)
    return problem, own, target, other, 1.0 if target.y < 0 else -1.0


@pytest.mark.parametrize(("distance", "success"), [(0.099, False), (0.101, True)])
def test_at_the_end_the_distractor_must_be_away_from_target_and_object(
    distance: float, success: bool
) -> None:
    problem, own, target, distractor, inward = single(TASK, conflict=True)
    for reached in (target, target.moved(dy=0.05 * inward)):
        beside_it = reached.moved(dy=distance * inward)
        outcome = judged(problem, {distractor.id: beside_it}, {own.id: reached})[1]
        assert (outcome.success, outcome.failure) == (success, not success)
    on_target = {distractor.id: target}  # until then it may be anywhere
    assert judged(problem, on_target, {distractor.id: FAR_AWAY}, {own.id: target})[1].success


def goals_of(problem: Problem) -> tuple[list[AtPose], list[AtPose]]:
    """Goals to arrange and goals to restore."""
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    num_arranged = problem.stages[0]
    assert sum(problem.stages) == len(goals) == len(problem.goals)
    return goals[:num_arranged], goals[num_arranged:]


def test_scenes_to_restore_are_those_of_rearrange(assets: Assets) -> None:
    for seed in range(30):
        first, second = (
            task_spec(task).sample(
                TableSampler(np.random.default_rng(seed), pool(task, "train"), assets=assets)
            )
            for task in (TASK, RESTORE)
        )
        assert first.scene == second.scene and list(first.goals) == goals_of(second)[0]
        assert first.prompt.images == second.prompt.images
        assert first.prerequisites == second.prerequisites


@pytest.mark.slow
def test_objects_go_back_to_their_starts_in_an_order_of_its_own() -> None:
    orders = []
    for episode in episodes(RESTORE, 3, 600):
        problem = episode.problem
        arrange, restore = goals_of(problem)
        assert problem.stages == (3, 3)
        arranged = [goal.object_id for goal in arrange]
        assert all(goal.target == problem.scene[goal.object_id].pose for goal in restore)
        assert all(goal.relative_to is None and in_workspace(goal.target) for goal in problem.goals)
        orders.append(tuple(arranged.index(goal.object_id) for goal in restore))
    assert_uniform(orders, itertools.permutations(range(3)))


def test_going_back_counts_from_the_step_after_the_last_arrangement_on() -> None:
    problem = episodes(RESTORE, 2)[0].problem
    a, b, *_ = moves(problem)
    a_back, b_back = ({object_id: problem.scene[object_id].pose for object_id in move} for move in (a, b))
    assert judged(problem, a | b) == judged(problem, a, a_back | b) == (Progress((2, 3)), Outcome())
    assert judged(problem, a | b, a_back | b_back)[1].success
    # Objects taken there and back one by one count: the picture need not exist as a whole.
    assert judged(problem, a, a_back, b, b_back)[1].success
    lost = dict.fromkeys(a, FAR_AWAY)
    assert judged(problem, lost)[1].failure and judged(problem, a | b, lost)[1].failure
    assert judged(problem, a | b, a_back, lost)[1] == Outcome()  # it has been restored


@pytest.mark.parametrize(("distance", "is_near"), [(0.099, True), (0.101, False)])
def test_ends_are_judged_at_the_target_and_where_it_was_at_any_heading(
    distance: float, is_near: bool
) -> None:
    problem, own, target, *_ = single(TASK, conflict=False)
    outcome = judged(problem, {own.id: target.moved(dx=distance).rotated(2.0)})[1]
    assert (outcome.success, outcome.failure) == (is_near, False)
    problem, own, target, distractor, _ = single(RESTORE, conflict=False)
    inward = 1.0 if own.pose.y < target.y else -1.0
    outcome = judged(problem, {own.id: target}, {own.id: own.pose.moved(dy=inward * distance).rotated(1)})[1]
    assert (outcome.success, outcome.failure) == (is_near, False)
    inward = 1.0 if own.pose.y < 0 else -1.0
    beside_it = {distractor.id: own.pose.moved(dy=inward * distance)}
    outcome = judged(problem, {own.id: target} | beside_it, {own.id: own.pose})[1]
    assert (outcome.failure, outcome.success) == (is_near, not is_near)


def test_a_distractor_that_was_in_the_way_is_left_where_it_is_parked() -> None:
    problem, own, target, distractor, _ = single(RESTORE, conflict=True)
    park = {distractor.id: problem.prerequisites[0].target}
    arrange, restore = {own.id: target}, {own.id: own.pose}
    assert judged(problem, park, {}, arrange) == (Progress((1,)), Outcome())  # waiting restores nothing
    assert judged(problem, park, arrange, restore)[1].success
    outcome = judged(problem, park, arrange, {distractor.id: distractor.pose}, restore)[1]
    assert outcome.failure and "is within 0.1 m of the target of" in outcome.reason
    assert judged(problem, arrange) == (Progress((1,)), Outcome())  # on top of it
    assert judged(problem, arrange, restore)[1].failure
    assert judged(problem, arrange, {distractor.id: FAR_AWAY}, restore)[1].success


def test_distractors_start_and_park_away_from_targets_and_starts() -> None:
    for episode in episodes(RESTORE, 1, 60):
        problem = episode.problem
        (arrange,), (restore,) = goals_of(problem)
        (other,) = (p for p in problem.scene.placements if p.id != arrange.object_id)
        assert other.pose.planar_distance(restore.target) >= 0.1
        if problem.prerequisites:
            parking = problem.prerequisites[0].target
            assert min(parking.planar_distance(goal.target) for goal in problem.goals) >= 0.1
        else:
            assert other.pose.planar_distance(arrange.target) >= 0.1


def test_the_distractor_can_be_asked_back_too() -> None:
    problem, own, target, distractor, _ = single(RESTORE, conflict=True, restore_distractor=True)
    park = {distractor.id: problem.prerequisites[0].target}
    arrange, restore, back = {own.id: target}, {own.id: own.pose}, {distractor.id: distractor.pose}
    assert judged(problem, park, arrange, restore)[1] == Outcome()
    assert judged(problem, park, arrange, restore, back)[1].success
    assert judged(problem, park, arrange, back, restore)[1].success
    on_top = judged(problem, arrange)[1]
    assert on_top.failure and "is within 0.1 m of the target of" in on_top.reason


def test_a_distractor_that_was_never_in_the_way_has_to_stay_when_asked_back() -> None:
    problem, own, target, distractor, _ = single(RESTORE, conflict=False, restore_distractor=True)
    arrange, restore = {own.id: target}, {own.id: own.pose}
    assert judged(problem, arrange, restore)[1].success
    inward = 0.15 if distractor.pose.y < 0 else -0.15
    elsewhere = {distractor.id: distractor.pose.moved(dy=inward)}
    assert judged(problem, elsewhere, arrange, restore)[1] == Outcome()
    assert judged(problem, {distractor.id: FAR_AWAY})[1].failure
    for seed in range(30):  # it changes no scene
        default, strict = (
            sample_episode(RESTORE, seed=seed, restore_distractor=word).problem for word in (False, True)
        )
        assert default.scene == strict.scene and default.prompt == strict.prompt
        assert strict.goals[: len(default.goals)] == default.goals


@pytest.mark.parametrize(
    ("num_objects", "options", "num_steps"),
    [
        (1, {"conflict": False}, 2),
        (1, {"conflict": True}, 3),
        (1, {"conflict": True, "restore_distractor": True}, 4),
        (2, {}, 4),
        (3, {}, 6),
    ],
)
def test_the_oracle_takes_the_shortest_way(
    num_objects: int, options: dict[str, Any], num_steps: int, assets: Assets
) -> None:
    (episode,) = episodes(RESTORE, num_objects, **options)
    problem, scene = episode.problem, episode.problem.scene
    progress, outcome, rng = begin(problem), Outcome(), np.random.default_rng(0)
    for _ in range(num_steps):
        assert not outcome.is_over
        decision = oracle_action(problem, progress, scene, assets=assets, rng=rng)
        waiting = (*problem.prerequisites, *(problem.goals[index] for index in progress.open_goals))
        goal = next(goal for goal in waiting if not goal.is_met(scene))
        assert decision.pick_id == goal.object_id
        scene = scene.with_poses({goal.object_id: goal.target})
        progress, outcome = advance(problem, progress, scene)
    assert outcome.success and num_steps <= episode.oracle_max_steps == 8
