"""Scenes and prompts of `same_shape` follow their specification; `test_gathering.py` judges outcomes."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from openvima.catalog import OBJECT_SETS, TEXTURE_SETS, Assets, object_spec, pool
from openvima.errors import ConfigError
from openvima.scene import Placement
from openvima.tasks import TableSampler, sample_episode, task_spec
from task_cases import assert_frequencies, assert_uniform, group_roles

TASK = "same_shape"
ALIKE = {
    "bowl": "ring",
    "frame": "shorter block",
    "container": "shorter block",
    "square": "shorter block",
    "pan": "round",
    "pallet": "shorter block",
}
TEXTURES = {"train": ("C1", "C2"), "L1": ("C1", "C2"), "L2": ("C2", "C1"), "L3": ("T_first", "T_second")}

Roles = tuple[Placement, list[Placement], list[Placement]]


@functools.cache
def all_roles(level: str, num_episodes: int) -> list[Roles]:
    return [group_roles(sample_episode(TASK, level=level, seed=seed).problem) for seed in range(num_episodes)]


@pytest.mark.parametrize(("level", "num_episodes"), [("train", 1000), ("L1", 300), ("L2", 300), ("L3", 500)])
@pytest.mark.slow
def test_each_level_has_its_shapes_and_textures(level: str, num_episodes: int) -> None:
    episodes = all_roles(level, num_episodes)
    dragged_textures, base_textures = (TEXTURE_SETS[name] for name in TEXTURES[level])
    bases = OBJECT_SETS["B_novel" if level == "L3" else "B_train"]
    candidates = OBJECT_SETS["D_shape_novel" if level == "L3" else "D_shape"]
    assert_uniform([base.object for base, _, _ in episodes], bases)
    assert_uniform([base.texture for base, _, _ in episodes], base_textures)
    assert_uniform([p.texture for _, dragged, _ in episodes for p in dragged], dragged_textures)
    assert_uniform([p.texture for _, _, distractors in episodes for p in distractors], dragged_textures)
    for base, dragged, distractors in episodes:
        assert {p.object for p in dragged} == {ALIKE[base.object]}
        assert all(object_spec(p.object).profile != object_spec(base.object).profile for p in distractors)
    assert {p.object for _, _, distractors in episodes for p in distractors} == set(candidates)


def test_distractors_of_a_round_base_are_all_that_is_not_round() -> None:
    shapes = [others[0].object for base, _, others in all_roles("train", 1000) if base.object == "bowl"]
    counts = {name: shapes.count(name) * 13 / len(shapes) for name in set(shapes)}
    assert set(counts) == set(OBJECT_SETS["D_shape"]) - {"ring"}
    assert all(0.6 < share < 1.6 for share in counts.values()), counts


def test_objects_to_gather_may_share_a_texture_but_not_with_a_distractor() -> None:
    episodes = all_roles("train", 1000)
    same = [first.texture == second.texture for _, (first, second), _ in episodes]
    assert_frequencies(same, {True: 1 / 19, False: 18 / 19})
    for _, dragged, distractors in episodes:
        assert {p.texture for p in dragged}.isdisjoint(p.texture for p in distractors)


@pytest.mark.parametrize("missing", ["ring", "shorter block"])
def test_a_pool_that_leaves_a_base_without_objects_is_refused(missing: str, assets: Assets) -> None:
    train = pool(TASK, "train")
    poor = replace(train, dragged_objects=tuple(n for n in train.dragged_objects if n != missing))
    table = TableSampler(np.random.default_rng(0), poor, assets=assets)
    with pytest.raises(ConfigError, match="some must have the profile of the base"):
        task_spec(TASK).sample(table)
