"""Scenes, pictures and outcomes of `scene_understanding` follow its specification."""

import re

import numpy as np
import pytest

from openvima.catalog import TEXTURE_SETS, Assets, pool
from openvima.scene import AtPose, DistractorsApart, Placement, Pose, Problem
from openvima.tasks import TableSampler, advance, begin, sample_episode, task_spec
from task_cases import assert_frequencies, assert_uniform, pictured

TASK = "scene_understanding"
NUM_EPISODES = 1000
SENTENCE = r"Put the ([\w ]+) object in \{scene\} into the ([\w ]+) object\."


def roles(problem: Problem) -> tuple[Placement, Placement, list[Placement]]:
    """Target, base and distractors."""
    (goal,) = problem.goals
    (constraint,) = problem.constraints
    assert isinstance(goal, AtPose) and goal.relative_to is not None
    assert isinstance(constraint, DistractorsApart) and not constraint.at_end
    scene = problem.scene
    return scene[goal.object_id], scene[goal.relative_to], [scene[i] for i in constraint.object_ids]


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, seed=seed).problem for seed in range(NUM_EPISODES)]


@pytest.mark.slow
def test_a_distractor_looks_like_the_base_or_has_the_texture_of_the_target(problems: list[Problem]) -> None:
    kinds = []
    for target, base, (distractor,) in map(roles, problems):
        is_base = distractor.object == base.object
        assert target.texture != base.texture
        assert distractor.fixed is is_base and base.fixed and not target.fixed
        if is_base:
            assert distractor.texture != base.texture
        else:
            assert distractor.texture == target.texture and distractor.object != target.object
        kinds.append(is_base)
    assert 0.44 < np.mean(kinds) < 0.51  # bases are a little harder to place


@pytest.mark.slow
def test_the_picture_shows_the_target_among_things_of_other_textures(problems: list[Problem]) -> None:
    num_same_shape = num_same_place = 0
    for problem in problems:
        target, _, _ = roles(problem)
        first, second = pictured(problem)
        shown, other = (first, second) if first.texture == target.texture else (second, first)
        assert (shown.object, shown.size, shown.texture) == (target.object, target.size, target.texture)
        assert other.texture != target.texture and {first.id, second.id} == {2, 3}
        assert shown.pose.planar_distance(other.pose) > 0.05
        num_same_shape += other.object == target.object
        num_same_place += shown.pose == target.pose
    assert 0.03 < num_same_shape / NUM_EPISODES < 0.085  # 1 in 18
    assert num_same_place == 0


@pytest.mark.slow
def test_ids_in_the_picture_do_not_tell_the_target(problems: list[Problem]) -> None:
    ids = (p.id for problem in problems for p in pictured(problem) if p.texture == roles(problem)[0].texture)
    assert_uniform(ids, (2, 3))


@pytest.mark.slow
def test_the_prompt_names_both_textures(problems: list[Problem]) -> None:
    assert task_spec(TASK).template == (
        "Put the {dragged_texture} object in {scene} into the {base_texture} object."
    )
    for problem in problems:
        target, base, _ = roles(problem)
        match = re.fullmatch(SENTENCE, problem.prompt.text)
        assert match and match.groups() == (target.texture, base.texture)


@pytest.mark.parametrize(
    ("target_at", "distractor_at", "success", "failure"),
    [
        (0.099, None, True, False),
        (0.101, None, False, False),
        (None, 0.099, False, True),
        (None, 0.101, False, False),
        (0.05, 0.14, False, True),  # in the base, but 0.09 m from the distractor
        (0.03, 0.14, True, False),
    ],
)
def test_distances_decide(
    target_at: float | None, distractor_at: float | None, success: bool, failure: bool
) -> None:
    problem = sample_episode(TASK, seed=1).problem
    target, base, (distractor,) = roles(problem)
    inward = 1.0 if base.pose.y < 0 else -1.0
    moved = {}
    for object_id, distance in ((target.id, target_at), (distractor.id, distractor_at)):
        if distance is not None:
            moved[object_id] = base.pose.moved(dy=inward * distance)
    outcome = advance(problem, begin(problem), problem.scene.with_poses(moved))[1]
    assert (outcome.success, outcome.failure) == (success, failure), outcome.reason


@pytest.mark.parametrize(("difficulty", "dragged", "base"), [("easy", "C1", "C2"), ("hard", "C2", "C1")])
def test_hard_exchanges_the_textures(difficulty: str, dragged: str, base: str) -> None:
    for seed in range(40):
        target, container, _ = roles(sample_episode(TASK, seed=seed, difficulty=difficulty).problem)
        assert target.texture in TEXTURE_SETS[dragged] and container.texture in TEXTURE_SETS[base]


@pytest.mark.slow
def test_medium_draws_two_different_textures_of_one_set() -> None:
    sets = []
    for seed in range(400):
        target, base, _ = roles(sample_episode(TASK, seed=seed, difficulty="medium").problem)
        assert target.texture != base.texture
        sets.append(target.texture in TEXTURE_SETS["C1"])
        assert (base.texture in TEXTURE_SETS["C1"]) is sets[-1]
    assert_frequencies(sets, {True: 0.5, False: 0.5})


def test_in_a_picture_hollow_bases_are_things_like_any_other(assets: Assets) -> None:
    table = TableSampler(np.random.default_rng(0), pool(TASK, "train"), assets=assets)
    shown = table.blank()
    shown.add("cross", "red", size=(0.128, 0.128, 0.032), pose=Pose.planar(0.5, 0.0))
    frame = shown.add("frame", "blue", size=(0.225, 0.225, 0.0), pose=Pose.planar(0.5, 0.2))
    assert not frame.fixed and table.placements == []
