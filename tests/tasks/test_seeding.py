"""Seeds of different domains, tasks, levels and purposes have nothing in common."""

import itertools
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given

from openvima.errors import ConfigError
from openvima.tasks import DOMAINS, make_rng
from strategies import seeds


def first_draw(*key: object, attempt: int = 0) -> int:
    return int(make_rng(*key, attempt=attempt).integers(2**63))  # type: ignore[arg-type]  # keys are built below


@given(seeds)
def test_equal_keys_give_equal_draws(seed: int) -> None:
    key = ("train", "rotate", "L1", seed, "scene")
    assert first_draw(*key) == first_draw(*key)


def test_no_two_keys_share_a_stream() -> None:
    keys = itertools.product(DOMAINS, ("rotate", "twist"), ("train", "L1"), range(50), ("scene", "oracle"))
    draws = [first_draw(*key) for key in keys]
    draws += [first_draw("user", "rotate", "train", 0, "scene", attempt=attempt) for attempt in range(1, 50)]
    assert len(set(draws)) == len(draws)


def test_large_seeds_do_not_wrap_onto_small_ones() -> None:
    assert first_draw("user", "rotate", "train", 2**32, "scene") != first_draw(
        "user", "rotate", "train", 0, "scene"
    )


def test_names_hash_alike_in_another_process() -> None:
    code = (
        "from openvima.tasks import make_rng; "
        "print(make_rng('eval', 'rotate', 'L2', 7, 'scene').integers(2**63))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(result.stdout) == first_draw("eval", "rotate", "L2", 7, "scene")


@pytest.mark.parametrize("seed", [-1, 2**63, 1.5, "7", None, True])
def test_a_seed_that_is_no_natural_number_is_refused(seed: object) -> None:
    with pytest.raises(ConfigError, match=r"seed is .*give an integer from 0"):
        first_draw("user", "rotate", "train", seed, "scene")


def test_numpy_integers_are_seeds_too() -> None:
    assert first_draw("user", "rotate", "train", np.int64(7), "scene") == first_draw(
        "user", "rotate", "train", 7, "scene"
    )


def test_an_unknown_domain_is_refused_with_a_suggestion() -> None:
    with pytest.raises(ConfigError, match="Did you mean 'train'"):
        first_draw("trian", "rotate", "train", 0, "scene")
