"""Scenes and prompts of `visual_manipulation` follow its specification."""

import collections

import pytest

from openvima.catalog import TEXTURE_SETS
from openvima.scene import AtPose, DistractorsApart, Placement, Problem
from openvima.tasks import sample_episode, task_spec

NUM_EPISODES = 2000


def cast(problem: Problem) -> tuple[Placement, Placement, list[Placement]]:
    """Target, base and distractors."""
    (goal,) = problem.goals
    (constraint,) = problem.constraints
    assert isinstance(goal, AtPose) and goal.relative_to is not None
    assert isinstance(constraint, DistractorsApart)
    return (
        problem.scene[goal.object_id],
        problem.scene[goal.relative_to],
        [problem.scene[i] for i in constraint.object_ids],
    )


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode("visual_manipulation", seed=seed).problem for seed in range(NUM_EPISODES)]


def assert_uniform(names: list[str], options: tuple[str, ...]) -> None:
    counts = collections.Counter(names)
    assert set(counts) == set(options)
    expected = len(names) / len(options)
    statistic = sum((count - expected) ** 2 / expected for count in counts.values())
    degrees = len(options) - 1
    assert statistic < degrees + 3.5 * (2 * degrees) ** 0.5 + 4, statistic  # beyond p = 0.001


def test_shapes_and_textures_are_uniform(problems: list[Problem]) -> None:
    pool = task_spec("visual_manipulation").pool("train")
    targets, bases = [cast(p)[0] for p in problems], [cast(p)[1] for p in problems]
    assert_uniform([t.texture for t in targets], pool.dragged_textures)
    assert_uniform([b.texture for b in bases], pool.base_textures)
    assert_uniform([b.object for b in bases], pool.base_objects)
    # Narrow shapes fit beside a hollow base more often, so targets are uniform only roughly.
    counts = collections.Counter(t.object for t in targets)
    assert set(counts) == set(pool.dragged_objects)
    assert all(0.6 < count * 14 / NUM_EPISODES < 1.5 for count in counts.values())


def test_a_distractor_shares_shape_or_texture_but_never_both(problems: list[Problem]) -> None:
    shared = collections.Counter()
    for problem in problems:
        target, base, (distractor,) = cast(problem)
        for name, other in (("target", target), ("base", base)):
            same_shape, same_texture = distractor.object == other.object, distractor.texture == other.texture
            assert not (same_shape and same_texture)
            shared[name, "shape"] += same_shape
            shared[name, "texture"] += same_texture
    assert min(shared.values()) > 10 and len(shared) == 4


def test_distractors_that_look_like_bases_are_fixed(problems: list[Problem]) -> None:
    pool = task_spec("visual_manipulation").pool("train")
    num_bases = 0
    for problem in problems:
        target, base, (distractor,) = cast(problem)
        assert base.fixed and not target.fixed
        assert distractor.fixed is (distractor.object in pool.base_objects)
        num_bases += distractor.fixed
    assert 0.15 < num_bases / NUM_EPISODES < 0.26  # 4 of 18 shapes, some of them harder to place


def test_nothing_starts_within_the_tolerance_of_anything(problems: list[Problem]) -> None:
    for problem in problems:
        placements = problem.scene.placements
        assert all(
            a.pose.planar_distance(b.pose) >= 0.1 for a in placements for b in placements if a.id < b.id
        )


def test_the_prompt_is_the_published_sentence(problems: list[Problem]) -> None:
    assert {p.prompt.text for p in problems} == {"Put the {dragged_obj_1} into the {base_obj}."}
    assert [name for name, _ in problems[0].prompt.images] == ["dragged_obj_1", "base_obj"]


def test_the_goal_is_the_place_of_the_base(problems: list[Problem]) -> None:
    (goal,) = problems[0].goals
    _, base, _ = cast(problems[0])
    assert isinstance(goal, AtPose)
    assert goal.target == base.pose and goal.tolerance.position_m == 0.1 and goal.tolerance.yaw_rad is None


@pytest.mark.parametrize(("difficulty", "dragged", "base"), [("easy", "C1", "C2"), ("hard", "C2", "C1")])
def test_hard_exchanges_the_textures(difficulty: str, dragged: str, base: str) -> None:
    for seed in range(40):
        problem = sample_episode("visual_manipulation", seed=seed, difficulty=difficulty).problem
        assert cast(problem)[0].texture in TEXTURE_SETS[dragged]
        assert cast(problem)[1].texture in TEXTURE_SETS[base]


def test_medium_draws_both_roles_from_one_of_the_sets() -> None:
    sets = collections.Counter()
    for seed in range(60):
        target, base, _ = cast(sample_episode("visual_manipulation", seed=seed, difficulty="medium").problem)
        both_first = target.texture in TEXTURE_SETS["C1"]
        assert (base.texture in TEXTURE_SETS["C1"]) is both_first
        sets[both_first] += 1
    assert min(sets.values()) > 15


@pytest.mark.parametrize("num_distractors", [0, 2, 3])
def test_the_number_of_distractors_can_be_chosen(num_distractors: int) -> None:
    for seed in range(20):
        problem = sample_episode("visual_manipulation", seed=seed, num_distractors=num_distractors).problem
        assert len(cast(problem)[2]) == num_distractors
        assert len(problem.scene.placements) == 2 + num_distractors
