"""Scenes and prompts of `same_shape` follow their specification; `test_gathering.py` judges outcomes."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from openvima.catalog import OBJECT_SETS, Assets, pool
from openvima.errors import ConfigError
from openvima.scene import Placement
from openvima.tasks import TableSampler, sample_episode, task_spec
from task_cases import assert_frequencies, group_roles

TASK = "same_shape"
Roles = tuple[Placement, list[Placement], list[Placement]]


@functools.cache
def all_roles(level: str, num_episodes: int) -> list[Roles]:
    return [group_roles(sample_episode(TASK, level=level, seed=seed).problem) for seed in range(num_episodes)]


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
