"""Scenes and prompts of `visual_manipulation` follow its specification."""

import collections

import pytest

from openvima.catalog import TEXTURE_SETS
from openvima.scene import AtPose, DistractorsApart, Placement, Problem
from openvima.tasks import advance, begin, sample_episode, task_spec
from task_cases import assert_frequencies

NUM_EPISODES = 1000


def roles(problem: Problem) -> tuple[Placement, Placement, list[Placement]]:
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


@pytest.mark.slow
def test_a_distractor_shares_shape_or_texture_but_never_both(problems: list[Problem]) -> None:
    shared = collections.Counter()
    for problem in problems:
        target, base, (distractor,) = roles(problem)
        for name, other in (("target", target), ("base", base)):
            same_shape, same_texture = distractor.object == other.object, distractor.texture == other.texture
            assert not (same_shape and same_texture)
            shared[name, "shape"] += same_shape
            shared[name, "texture"] += same_texture
    assert min(shared.values()) > 10 and len(shared) == 4


@pytest.mark.slow
def test_distractors_that_look_like_bases_are_fixed(problems: list[Problem]) -> None:
    pool = task_spec("visual_manipulation").pool("train")
    num_bases = 0
    for problem in problems:
        target, base, (distractor,) = roles(problem)
        assert base.fixed and not target.fixed
        assert distractor.fixed is (distractor.object in pool.base_objects)
        num_bases += distractor.fixed
    assert 0.15 < num_bases / NUM_EPISODES < 0.26  # 4 of 18 shapes, some of them harder to place


@pytest.mark.parametrize(("difficulty", "dragged", "base"), [("easy", "C1", "C2"), ("hard", "C2", "C1")])
def test_hard_exchanges_the_textures(difficulty: str, dragged: str, base: str) -> None:
    for seed in range(40):
        problem = sample_episode("visual_manipulation", seed=seed, difficulty=difficulty).problem
        assert roles(problem)[0].texture in TEXTURE_SETS[dragged]
        assert roles(problem)[1].texture in TEXTURE_SETS[base]


def test_medium_draws_both_roles_from_one_of_the_sets() -> None:
    sets = []
    for seed in range(200):
        target, base, _ = roles(sample_episode("visual_manipulation", seed=seed, difficulty="medium").problem)
        sets.append(target.texture in TEXTURE_SETS["C1"])
        assert (base.texture in TEXTURE_SETS["C1"]) is sets[-1]
    assert_frequencies(sets, {True: 0.5, False: 0.5})


@pytest.mark.parametrize(
    ("target_at", "distractor_at", "success", "failure"),
    [
        (0.099, None, True, False),
        (0.101, None, False, False),
        (None, 0.099, False, True),
        (None, 0.101, False, False),
        (0.05, 0.14, False, True),  # in the base, but 0.09 m from the distractor
    ],
)
def test_distances_decide(
    target_at: float | None, distractor_at: float | None, success: bool, failure: bool
) -> None:
    problem = sample_episode("visual_manipulation", seed=1).problem
    target, base, (distractor,) = roles(problem)
    inward = 1.0 if base.pose.y < 0 else -1.0
    moved = {
        object_id: base.pose.moved(dy=inward * distance)
        for object_id, distance in ((target.id, target_at), (distractor.id, distractor_at))
        if distance is not None
    }
    outcome = advance(problem, begin(problem), problem.scene.with_poses(moved))[1]
    assert (outcome.success, outcome.failure) == (success, failure), outcome.reason
