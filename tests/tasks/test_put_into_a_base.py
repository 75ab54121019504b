"""Tasks that put one object into a base; `visual_manipulation` and `scene_understanding` by specification."""

import collections
import re

import numpy as np
import pytest

from openvima.catalog import TEXTURE_SETS, Assets, pool
from openvima.scene import Pose, Problem
from openvima.tasks import TableSampler, sample_episode, task_spec
from task_cases import assert_frequencies, assert_judged_at_its_limits, assert_uniform, pictured, roles

NUM_EPISODES = 1000
SENTENCE = r"Put the ([\w ]+) object in \{scene\} into the ([\w ]+) object\."


def problems(task: str) -> list[Problem]:
    return [sample_episode(task, seed=seed).problem for seed in range(NUM_EPISODES)]


@pytest.mark.slow
def test_a_distractor_shares_shape_or_texture_but_never_both_and_is_fixed_if_a_base() -> None:
    bases = task_spec("visual_manipulation").pool("train").base_objects
    shared = collections.Counter()
    num_bases = 0
    for problem in problems("visual_manipulation"):
        target, base, (distractor,) = roles(problem)
        for name, other in (("target", target), ("base", base)):
            same_shape, same_texture = distractor.object == other.object, distractor.texture == other.texture
            assert not (same_shape and same_texture)
            shared[name, "shape"] += same_shape
            shared[name, "texture"] += same_texture
        assert base.fixed and not target.fixed
        assert distractor.fixed is (distractor.object in bases)
        num_bases += distractor.fixed
    assert min(shared.values()) > 10 and len(shared) == 4
    assert 0.15 < num_bases / NUM_EPISODES < 0.26  # 4 of 18 shapes, some of them harder to place


@pytest.mark.slow
def test_the_picture_shows_the_target_and_the_prompt_names_both_textures() -> None:
    kinds, target_ids = [], []
    num_same_shape = 0
    for problem in problems("scene_understanding"):
        target, base, (distractor,) = roles(problem)
        is_base = distractor.object == base.object
        assert target.texture != base.texture
        assert distractor.fixed is is_base and base.fixed and not target.fixed
        if is_base:
            assert distractor.texture != base.texture
        else:
            assert distractor.texture == target.texture and distractor.object != target.object
        kinds.append(is_base)

        first, second = pictured(problem)
        shown, other = (first, second) if first.texture == target.texture else (second, first)
        assert (shown.object, shown.size, shown.texture) == (target.object, target.size, target.texture)
        assert other.texture != target.texture and {first.id, second.id} == {2, 3}
        assert shown.pose.planar_distance(other.pose) > 0.05 and shown.pose != target.pose
        num_same_shape += other.object == target.object
        target_ids.append(shown.id)

        match = re.fullmatch(SENTENCE, problem.prompt.text)
        assert match and match.groups() == (target.texture, base.texture)
    assert 0.44 < np.mean(kinds) < 0.51  # bases are a little harder to place
    assert 0.03 < num_same_shape / NUM_EPISODES < 0.085  # 1 in 18
    assert_uniform(target_ids, (2, 3))


def test_in_a_picture_hollow_bases_are_things_like_any_other(assets: Assets) -> None:
    table = TableSampler(np.random.default_rng(0), pool("scene_understanding", "train"), assets=assets)
    shown = table.blank()
    shown.add("cross", "red", size=(0.128, 0.128, 0.032), pose=Pose.planar(0.5, 0.0))
    frame = shown.add("frame", "blue", size=(0.225, 0.225, 0.0), pose=Pose.planar(0.5, 0.2))
    assert not frame.fixed and table.placements == []


@pytest.mark.parametrize("task", ["visual_manipulation", "scene_understanding", "novel_noun"])
@pytest.mark.parametrize(
    ("difficulty", "shares"),
    [
        ("easy", {("C1", "C2"): 1.0}),
        ("medium", {("C1", "C1"): 0.5, ("C2", "C2"): 0.5}),
        ("hard", {("C2", "C1"): 1.0}),
    ],
)
def test_the_difficulty_says_who_gets_which_textures(
    task: str, difficulty: str, shares: dict[tuple[str, str], float]
) -> None:
    drawn = []
    for seed in range(60):
        target, base, _ = roles(sample_episode(task, seed=seed, difficulty=difficulty).problem)
        names = [[name for name in ("C1", "C2") if p.texture in TEXTURE_SETS[name]] for p in (target, base)]
        drawn.append(tuple(name for (name,) in names))
    assert set(drawn) == set(shares)
    if len(shares) > 1:
        assert_frequencies(drawn, shares)


@pytest.mark.parametrize(
    ("task", "level", "options"),
    [
        ("visual_manipulation", "train", {}),
        ("scene_understanding", "train", {}),
        ("novel_noun", "L3", {}),
        ("novel_adj", "train", {"difficulty": "hard", "num_distractors": 1}),
        ("novel_adj_and_noun", "L4", {"difficulty": "hard"}),
    ],
)
def test_outcomes_change_at_the_limits(task: str, level: str, options: dict[str, object]) -> None:
    for seed in range(5):
        assert_judged_at_its_limits(sample_episode(task, level=level, seed=seed, **options).problem)
