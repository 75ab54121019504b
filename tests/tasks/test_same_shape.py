"""`same_shape` and `same_texture`: what belongs together, and gathering it."""

import functools

import pytest

from openvima.catalog import OBJECT_SETS, TEXTURE_SETS
from openvima.catalog.objects import OBJECTS
from openvima.scene import Outcome, Placement, Pose, Problem
from openvima.tasks import Progress, sample_episode
from openvima.tasks.table import is_in_the_way
from task_cases import (
    assert_frequencies,
    assert_uniform,
    beside,
    group_roles,
    judge_step,
    judged,
    tolerance_m,
)

LEVELS = {"same_texture": "L4", "same_shape": "train"}
NUM_EPISODES = 350
BASES = ("pan", "bowl", "container", "frame", "pallet", "square")
KIT = tuple(name for name, spec in OBJECTS.items() if spec.kind == "kit")

both_tasks = pytest.mark.parametrize("task", LEVELS)
Roles = tuple[Placement, list[Placement], list[Placement]]


def problem_of(task: str, seed: int = 0, **options: object) -> Problem:
    return sample_episode(task, level=LEVELS[task], seed=seed, **options).problem


def problem_with(task: str, *, bowl: bool, **options: object) -> Problem:
    """The first problem whose base is a bowl, or is none."""
    problems = (problem_of(task, seed, **options) for seed in range(100))
    return next(problem for problem in problems if (group_roles(problem)[0].object == "bowl") is bowl)


@functools.cache
def all_roles(task: str) -> list[Roles]:
    return [group_roles(problem_of(task, seed)) for seed in range(NUM_EPISODES)]


@both_tasks
@pytest.mark.parametrize(
    ("difficulty", "num_dragged", "num_distractors"), [("easy", 2, 1), ("medium", 2, 2), ("hard", 3, 3)]
)
def test_difficulty_sets_the_counts_and_the_steps(
    task: str, difficulty: str, num_dragged: int, num_distractors: int
) -> None:
    for seed in range(10):
        episode = sample_episode(task, level=LEVELS[task], seed=seed, difficulty=difficulty)
        base, dragged, distractors = group_roles(episode.problem)
        assert (len(dragged), len(distractors)) == (num_dragged, num_distractors)
        assert len(episode.problem.scene.placements) == 1 + num_dragged + num_distractors
        assert base.fixed and not any(p.fixed for p in (*dragged, *distractors))
        assert episode.oracle_max_steps == num_dragged + 2
        ((name, image),) = episode.problem.prompt.images
        assert name == "base_obj" and image.placement == base


@both_tasks
@pytest.mark.slow
def test_what_would_decide_the_episode_is_kept_apart_at_the_start_and_nothing_else(task: str) -> None:
    distances = []
    for seed in range(200):
        problem = problem_of(task, seed, difficulty="hard" if seed % 2 else "easy")
        base, dragged, distractors = group_roles(problem)
        limit = tolerance_m(problem)
        assert all(not is_in_the_way(p, base) for p in (*dragged, *distractors))
        assert all(p.pose.planar_distance(base.pose) >= limit for p in (*dragged, *distractors))
        assert all(d.pose.planar_distance(p.pose) >= limit for d in distractors for p in dragged)
        assert judge_step(problem, {}) == Outcome()
        distances.append(dragged[0].pose.planar_distance(dragged[1].pose))
    assert min(distances) < 0.125


def test_with_compat_an_episode_may_be_lost_at_the_start() -> None:
    problems = (
        problem_of("same_texture", seed, compat=True, after_bowl=False, difficulty="hard")
        for seed in range(100)
    )
    assert any(judge_step(problem, {}).failure for problem in problems)


@both_tasks
@pytest.mark.parametrize(("bowl", "limit"), [(True, 0.0875), (False, 0.125)])
def test_outcomes_change_at_the_limits(task: str, bowl: bool, limit: float) -> None:
    problem = problem_with(task, bowl=bowl)
    base, (first, second), (distractor,) = group_roles(problem)
    assert tolerance_m(problem) == limit

    def within_and_beyond(moved: Placement, anchor: Pose) -> list[dict[int, Pose]]:
        distances = (limit - 1e-3, limit + 1e-3)
        return [{moved.id: beside(problem, anchor, d, moved_id=moved.id)} for d in distances]

    done = {first.id: base.pose}
    near, far = within_and_beyond(second, base.pose)
    assert judged(problem, done, near)[1].success
    assert judged(problem, near, done)[1].success
    assert judged(problem, done, far) == (Progress((1,)), Outcome())
    near, far = within_and_beyond(distractor, base.pose)
    assert "of the target of" in judge_step(problem, near).reason
    assert judge_step(problem, far) == Outcome()
    assert judge_step(problem, {**done, second.id: base.pose, **near}).failure
    near, far = within_and_beyond(first, distractor.pose)
    assert judge_step(problem, near).failure
    assert judge_step(problem, far) == Outcome()
    assert judged(problem, done, {**near, second.id: base.pose})[1].failure  # even once it has been counted


@both_tasks
def test_the_bowls_tolerance_can_be_made_to_hold_for_every_base(task: str) -> None:
    assert tolerance_m(problem_with(task, bowl=False, after_bowl=True)) == 0.0875
    assert tolerance_m(problem_with(task, bowl=False, compat=True)) == 0.0875
    assert tolerance_m(problem_with(task, bowl=False, compat=True, after_bowl=False)) == 0.125
    assert tolerance_m(problem_with(task, bowl=True, after_bowl=False)) == 0.0875


def test_distractors_of_a_round_base_are_all_that_is_not_round() -> None:
    shapes = [others[0].object for base, _, others in all_roles("same_shape") if base.object == "bowl"]
    assert_uniform(shapes, set(OBJECT_SETS["D_shape"]) - {"ring"})


def test_objects_to_gather_may_share_a_texture_but_not_with_a_distractor() -> None:
    episodes = all_roles("same_shape")
    same = [first.texture == second.texture for _, (first, second), _ in episodes]
    assert_frequencies(same, {True: 1 / 19, False: 18 / 19})
    for _, dragged, distractors in episodes:
        assert {p.texture for p in dragged}.isdisjoint(p.texture for p in distractors)


def test_the_texture_alone_tells_what_belongs_together() -> None:
    episodes = all_roles("same_texture")
    assert len(TEXTURE_SETS["T_first"]) == 24 and len(TEXTURE_SETS["T_second"]) == 25 and len(KIT) == 18
    assert_uniform([base.object for base, _, _ in episodes], BASES)
    assert_uniform([base.texture for base, _, _ in episodes], TEXTURE_SETS["T_second"])
    assert_uniform([d.texture for _, _, (d,) in episodes], TEXTURE_SETS["T_first"])
    for base, dragged, _ in episodes:
        assert {p.texture for p in dragged} == {base.texture}
    for shapes in (
        [p.object for _, dragged, _ in episodes for p in dragged],
        [distractor.object for _, _, (distractor,) in episodes],
    ):
        assert_uniform(shapes, (*KIT, "shorter block"))
    one_in_19 = {True: 1 / 19, False: 18 / 19}
    assert_frequencies([first.object == second.object for _, (first, second), _ in episodes], one_in_19)
    assert_frequencies([dragged[0].object == d.object for _, dragged, (d,) in episodes], one_in_19)
