"""Intervals of the difference and the ratio of two independent means."""

import numpy as np
import pytest

from openvima.evaluation.statistics import difference_of_means, ratio_of_means, wilson_interval


def estimated(successes: int, episodes: int) -> tuple[float, tuple[float, float]]:
    return successes / episodes, wilson_interval(successes, episodes)


def test_the_difference_of_two_rates_agrees_with_a_printed_example():
    # Newcombe 1998, table II, (a) 56/70 − 48/80, method 10
    value, interval = difference_of_means(estimated(56, 70), estimated(48, 80))
    assert value == pytest.approx(0.2)
    assert interval == pytest.approx((0.0524, 0.3339), abs=5e-5)


def test_the_difference_of_two_rates_agrees_with_statsmodels():
    proportions = pytest.importorskip("statsmodels.stats.proportion")
    for a, b in ((0, 30), (7, 12), (30, 30)):
        own = difference_of_means(estimated(a, 30), estimated(b, 40))[1]
        other = proportions.confint_proportions_2indep(a, 30, b, 40, method="newcomb", compare="diff")
        assert own == pytest.approx(other, abs=1e-9)


def test_the_interval_of_a_ratio_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    for rate_a, rate_b in ((0.4, 0.8), (0.1, 0.5), (0.7, 0.9)):
        found = [
            ratio_of_means(estimated(int(a), 200), estimated(int(b), 200))
            for a, b in zip(rng.binomial(200, rate_a, 600), rng.binomial(200, rate_b, 600), strict=True)
        ]
        covers = [f is not None and f[1][0] <= rate_a / rate_b <= f[1][1] for f in found]
        assert 0.92 <= np.mean(covers) <= 0.98


def test_a_ratio_is_bounded_at_the_ends_and_refused_near_zero():
    assert ratio_of_means(estimated(3, 200), estimated(0, 200)) is None
    assert ratio_of_means(estimated(3, 200), estimated(2, 200)) is None
    none = ratio_of_means(estimated(0, 200), estimated(160, 200))
    assert none is not None and none[0] == 0 and none[1][0] == 0 < none[1][1] < 0.03
