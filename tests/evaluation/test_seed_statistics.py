"""Means over training seeds: variance components, Student's interval, coverage."""

import numpy as np
import pytest

from openvima.errors import ConfigError
from openvima.evaluation.statistics import (
    PairCounts,
    difference_over_seeds,
    mean_difference,
    mean_of_rates,
    mean_over_seeds,
    student_quantile,
)


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 7, 30])
def test_student_quantiles_are_those_of_scipy(degrees: int) -> None:
    stats = pytest.importorskip("scipy.stats")
    for confidence in (0.5, 0.95, 0.999):
        expected = stats.t.ppf(0.5 + confidence / 2, degrees)
        assert student_quantile(confidence, degrees) == pytest.approx(expected, rel=1e-9)


def test_one_seed_has_the_interval_of_its_episodes() -> None:
    counts = [(40, 50), (10, 50)]
    found = mean_over_seeds([counts])
    assert (found.mean, found.interval) == mean_of_rates(counts)
    assert found.sd is None and found.training_sd is None


def test_the_deviation_of_seeds_is_split_into_episodes_and_trainings() -> None:
    found = mean_over_seeds([[(20, 100)], [(50, 100)], [(80, 100)]])
    assert found.sd == pytest.approx(0.3)
    assert found.episode_sd**2 == pytest.approx((0.16 + 0.25 + 0.16) / 3 / 99)
    assert found.training_sd is not None
    assert found.training_sd**2 + found.episode_sd**2 == pytest.approx(found.sd**2)
    half = 4.302653 * 0.3 / 3**0.5
    assert found.interval == pytest.approx((max(0, 0.5 - half), min(1, 0.5 + half)), abs=1e-6)


def test_equal_seeds_keep_the_interval_of_all_episodes() -> None:
    found = mean_over_seeds([[(50, 50)]] * 3)
    assert found.interval == mean_of_rates([(150, 150)])[1]
    assert found.training_sd == 0


def test_a_difference_over_seeds_spans_pooled_episodes_and_seeds() -> None:
    pairs = [[PairCounts(10, 30, 5, 5)], [PairCounts(10, 10, 25, 5)], [PairCounts(10, 20, 15, 5)]]
    difference, interval = difference_over_seeds(pairs)
    pooled = mean_difference([PairCounts(30, 60, 45, 15)])
    assert difference == pytest.approx(pooled[0])
    assert interval[0] < pooled[1][0] and interval[1] > pooled[1][1]


@pytest.mark.parametrize("counts", [[], [[(1, 2)], [(1, 2), (1, 2)]], [[(3, 2)]]])
def test_seeds_that_do_not_match_are_refused(counts: list) -> None:
    with pytest.raises(ConfigError):
        mean_over_seeds(counts)


@pytest.mark.parametrize(("rate", "training_sd"), [(0.97, 0.02), (0.5, 0.15)])
def test_intervals_over_three_seeds_cover_the_mean_of_all_trainings(rate: float, training_sd: float) -> None:
    rng = np.random.default_rng(7)
    true_mean = np.clip(rate + training_sd * rng.standard_normal(100_000), 0, 1).mean()
    trainings = np.clip(rate + training_sd * rng.standard_normal((120, 3)), 0, 1)
    intervals = [
        mean_over_seeds([[(s, 50)] for s in found]).interval for found in rng.binomial(50, trainings)
    ]
    assert sum(low <= true_mean <= high for low, high in intervals) >= 0.93 * len(intervals)
