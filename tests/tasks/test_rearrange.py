"""Scenes, pictures and outcomes of `rearrange` follow its specification."""

import pytest

from openvima.catalog import TEXTURE_SETS, Assets, pool
from openvima.scene import AtPose, DistractorsApart, Outcome, Placement, Pose, Problem
from openvima.tasks import sample_episode
from openvima.tasks.table import is_in_the_way
from task_cases import assert_frequencies, assert_uniform, judged, pictured

TASK = "rearrange"
NUM_EPISODES = 1250
FAR_AWAY = Pose.planar(0.9, 0.0)


def moves(problem: Problem) -> list[tuple[Placement, Pose]]:
    """Each object to move, where it stands, and its target."""
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    assert len(goals) == len(problem.goals)
    return [(problem.scene[goal.object_id], goal.target) for goal in goals]


def distractor_of(problem: Problem) -> Placement | None:
    (constraint,) = problem.constraints
    assert isinstance(constraint, DistractorsApart) and constraint.at_end
    ids = constraint.object_ids
    return problem.scene[ids[0]] if ids else None


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, seed=seed).problem for seed in range(NUM_EPISODES)]


@pytest.fixture(scope="module")
def conflict() -> Problem:
    """One object, its target taken by the distractor."""
    return sample_episode(TASK, seed=2, num_objects=1, conflict_rate=1).problem


@pytest.fixture(scope="module")
def clean() -> Problem:
    """One object, its target free, a distractor elsewhere."""
    return sample_episode(TASK, seed=2, num_objects=1, conflict_rate=0).problem


@pytest.mark.slow
def test_one_two_or_three_objects_have_to_be_moved(problems: list[Problem]) -> None:
    assert_frequencies((len(p.goals) for p in problems), {1: 0.4, 2: 0.4, 3: 0.2})


@pytest.mark.slow
def test_only_a_single_object_has_a_distractor_and_half_of_these_are_in_its_way(
    problems: list[Problem],
) -> None:
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
    for seed in range(1000):
        problem = sample_episode(TASK, level=level, seed=seed, num_objects=1).problem
        ((target, _),), distractor = moves(problem), distractor_of(problem)
        assert distractor is not None and distractor.object != target.object
        assert target.object in pool(TASK, level).dragged_objects
        assert target.texture in pool(TASK, level).dragged_textures
        assert not distractor.fixed
        distractors.append(distractor)
    assert_uniform((d.texture for d in distractors), TEXTURE_SETS["T"])
    assert {d.object for d in distractors} == set(pool(TASK, level).dragged_objects)


def test_distractors_can_be_kept_to_the_textures_of_the_level() -> None:
    for level, textures in (("train", "C1"), ("L2", "C2")):
        for seed in range(60):
            episode = sample_episode(TASK, level=level, seed=seed, num_objects=1, distractor_textures="pool")
            assert {p.texture for p in episode.problem.scene.placements} <= set(TEXTURE_SETS[textures])


@pytest.mark.slow
def test_nothing_starts_in_the_way_of_a_target(problems: list[Problem]) -> None:
    for problem in problems:
        goals, taken = moves(problem), distractor_of(problem)
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
        ((own, target),) = moves(problem)
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
        assert shown == {(p.object, p.texture, p.size, target) for p, target in moves(problem)}
        assert sorted(p.id for p in pictured(problem)) == list(range(2, 2 + len(problem.goals)))


def ids(problem: Problem) -> tuple[int, int]:
    """The single object to move and the distractor."""
    distractor = distractor_of(problem)
    assert distractor is not None
    return moves(problem)[0][0].id, distractor.id


@pytest.mark.parametrize(("distance", "success"), [(0.0, True), (0.099, True), (0.101, False)])
@pytest.mark.parametrize("yaw_rad", [0.0, 2.0])
def test_an_object_has_to_be_near_its_target_at_any_heading(
    clean: Problem, distance: float, yaw_rad: float, success: bool
) -> None:
    ((own, target),) = moves(clean)
    outcome = judged(clean, {own.id: target.moved(dx=distance).rotated(yaw_rad)})[1]
    assert (outcome.success, outcome.failure) == (success, False)


def test_objects_may_be_moved_in_any_order_and_stay_done() -> None:
    problem = sample_episode(TASK, seed=0, num_objects=3).problem
    (a, at_a), (b, at_b), (c, at_c) = moves(problem)
    progress, outcome = judged(problem, {c.id: at_c}, {a.id: at_a, c.id: FAR_AWAY})
    assert progress.open_goals == (1,) and outcome == Outcome()
    assert judged(problem, {c.id: at_c}, {a.id: at_a, c.id: FAR_AWAY}, {b.id: at_b})[1].success


def test_a_parked_distractor_leaves_the_target_to_the_object(conflict: Problem) -> None:
    ((own, target),), (_, distractor) = moves(conflict), ids(conflict)
    inward = 1.0 if target.y < 0 else -1.0
    for parked in (conflict.prerequisites[0].target, target.moved(dy=0.101 * inward), FAR_AWAY):
        assert judged(conflict, {distractor: parked}, {own.id: target})[1].success


@pytest.mark.parametrize(("distance", "success"), [(0.099, False), (0.101, True)])
def test_at_the_end_the_distractor_must_be_away_from_target_and_object(
    conflict: Problem, distance: float, success: bool
) -> None:
    ((own, target),), (_, distractor) = moves(conflict), ids(conflict)
    inward = 1.0 if target.y < 0 else -1.0
    near_target = judged(conflict, {distractor: target.moved(dy=distance * inward)}, {own.id: target})[1]
    askew = target.moved(dy=0.05 * inward)
    beside_it = askew.moved(dy=distance * inward)
    near_object = judged(conflict, {distractor: beside_it}, {own.id: askew})[1]
    for outcome in (near_target, near_object):
        assert (outcome.success, outcome.failure) == (success, not success)


def test_a_distractor_may_be_anywhere_until_the_object_is_there(clean: Problem) -> None:
    ((own, target),), (_, distractor) = moves(clean), ids(clean)
    on_target = {distractor: target}
    assert judged(clean, on_target)[1] == Outcome()
    assert judged(clean, on_target, {distractor: FAR_AWAY}, {own.id: target})[1].success
    assert judged(clean, on_target, {own.id: target})[1].failure
