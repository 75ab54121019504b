"""Paired comparisons: against published values, libraries, slow twins, and what must hold in any case."""

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openvima.errors import ConfigError
from openvima.evaluation.statistics import PairCounts, holm, mcnemar, mean_difference

COUNTS = st.builds(PairCounts, *[st.integers(0, 30)] * 3, st.integers(1, 30))
ODD_COUNTS = [
    (0, 0, 0, 5),
    (5, 0, 0, 0),
    (0, 5, 0, 0),
    (0, 0, 5, 0),
    (0, 3, 3, 0),
    (0, 1, 0, 0),
    (9, 1, 0, 0),
]


def tango_statistic(counts: PairCounts, delta: float) -> float:
    """The statistic as printed in Tango 1998, with its closed form of the constrained probability."""
    n, a, b = counts.episodes, counts.only_a, counts.only_b
    linear = -a - b + (2 * n - a + b) * delta
    only_b = (math.sqrt(max(0.0, linear**2 + 8 * n * b * delta * (1 - delta))) - linear) / (4 * n)
    return (a - b - n * delta) / math.sqrt(n * (2 * only_b + delta * (1 - delta)))


def test_the_interval_of_a_difference_gives_the_published_value():
    # airway hyper-responsiveness before and after a transplantation, as in Fagerland et al. 2014
    difference, interval = mean_difference([PairCounts(1, 1, 7, 12)])
    assert difference == pytest.approx(-6 / 21)
    assert interval == pytest.approx((-0.517, -0.026), abs=5e-4)


@pytest.mark.parametrize(
    "counts", [(1, 1, 7, 12), (50, 40, 20, 50), (10, 3, 0, 7), (8, 0, 0, 0), (0, 2, 9, 0)]
)
def test_ends_of_the_interval_are_where_tangos_statistic_is_critical(counts):
    pairs = PairCounts(*counts)
    _, (low, high) = mean_difference([pairs])
    assert tango_statistic(pairs, low) == pytest.approx(1.959964, abs=1e-5)
    assert tango_statistic(pairs, high) == pytest.approx(-1.959964, abs=1e-5)


@pytest.mark.slow
def test_the_interval_agrees_with_mcnemars_chi_squared_test_on_what_is_noise():
    mcnemar_of = pytest.importorskip("statsmodels.stats.contingency_tables").mcnemar
    for only_a, only_b in product(range(13), range(13)):
        if only_a + only_b:
            p = mcnemar_of([[20, only_a], [only_b, 9]], exact=False, correction=False).pvalue
            _, (low, high) = mean_difference([PairCounts(20, only_a, only_b, 9)])
            assert (p < 0.05) == (low > 0 or high < 0), (only_a, only_b)


def test_mcnemar_agrees_with_statsmodels():
    mcnemar_of = pytest.importorskip("statsmodels.stats.contingency_tables").mcnemar
    for only_a, only_b in [(0, 1), (1, 7), (7, 1), (5, 5), (12, 30), (200, 260), (0, 40)]:
        expected = mcnemar_of([[3, only_a], [only_b, 4]], exact=True).pvalue
        assert mcnemar(only_a, only_b)[0] == pytest.approx(expected, rel=1e-9)


def test_mid_p_is_the_tail_with_half_of_what_was_observed():
    binom = pytest.importorskip("scipy.stats").binom
    for only_a, only_b in [(0, 1), (1, 7), (12, 30), (300, 260)]:
        fewer, tosses = min(only_a, only_b), only_a + only_b
        expected = 2 * (binom.cdf(fewer - 1, tosses, 0.5) + binom.pmf(fewer, tosses, 0.5) / 2)
        assert mcnemar(only_a, only_b)[1] == pytest.approx(expected, rel=1e-9)


def test_equal_policies_have_p_of_one():
    assert mcnemar(0, 0) == (1.0, 0.5)
    assert mcnemar(4, 4)[0] == 1.0


def test_thousands_of_episodes_do_not_overflow():
    assert mcnemar(3000, 3600)[0] == pytest.approx(1.6e-13, rel=0.2)


def test_a_stratified_interval_is_critical_under_the_constrained_maximum_of_the_likelihood():
    optimize = pytest.importorskip("scipy.optimize")
    counts = [PairCounts(5, 4, 1, 10), PairCounts(30, 9, 6, 5), PairCounts(2, 3, 3, 4)]
    estimate, (low, _) = mean_difference(counts)
    solved = np.array([(c.only_a, c.only_b, c.both + c.neither) for c in counts], float)
    played = solved.sum(axis=1)

    def cost(p: np.ndarray) -> float:
        a, b = p.reshape(2, 3)
        return -np.sum(solved * np.log(np.maximum(1e-12, [a, b, 1 - a - b])).T)

    constraint = {"type": "eq", "fun": lambda p: np.mean(p[:3] - p[3:]) - low}
    best = optimize.minimize(
        cost, np.full(6, 0.2), bounds=[(1e-9, 1)] * 6, constraints=[constraint], options={"ftol": 1e-13}
    )
    a, b = best.x.reshape(2, 3)
    variance = np.sum((a + b - (a - b) ** 2) / (played - 2 / 3)) / 9  # 2 of 3 degrees of freedom are spent
    assert (estimate - low) / math.sqrt(variance) == pytest.approx(1.959964, abs=1e-3)


@pytest.mark.parametrize("counts", ODD_COUNTS)
def test_extreme_counts_have_a_finite_interval_around_the_difference(counts):
    pairs = PairCounts(*counts)
    difference, (low, high) = mean_difference([pairs])
    assert -1 <= low <= difference <= high <= 1
    assert high - low > 0.1


@given(st.lists(COUNTS, min_size=1, max_size=5))
def test_swapping_the_policies_mirrors_the_interval(counts):
    difference, (low, high) = mean_difference(counts)
    assert -1 <= low <= difference <= high <= 1
    mirrored, interval = mean_difference([count.swapped for count in counts])
    assert mirrored == -difference
    assert interval == pytest.approx((-high, -low), abs=1e-9)


def test_pairing_pays_where_policies_fail_on_the_same_episodes():
    _, alike = mean_difference([PairCounts(40, 7, 1, 52)])
    _, unlike = mean_difference([PairCounts(20, 27, 21, 32)])  # the same two success rates
    assert alike[0] > 0 > unlike[0]


@pytest.mark.parametrize("counts", [(0, 0, 0, 0), (-1, 2, 2, 2)])
def test_impossible_pair_counts_are_refused(counts):
    with pytest.raises(ConfigError, match="cannot be compared"):
        PairCounts(*counts)


def test_no_counts_and_impossible_settings_are_refused():
    with pytest.raises(ConfigError, match="at least one task"):
        mean_difference([])
    with pytest.raises(ConfigError, match="confidence is 95"):
        mean_difference([PairCounts(1, 1, 1, 1)], confidence=95)
    with pytest.raises(ConfigError, match="at least 0"):
        mcnemar(-1, 3)


@pytest.mark.slow
def test_holm_agrees_with_statsmodels():
    multipletests = pytest.importorskip("statsmodels.stats.multitest").multipletests
    for p_values in ([0.01, 0.04, 0.03], [0.2], [0.5, 0.9, 0.001, 0.001, 0.02], [1.0, 1.0]):
        assert holm(p_values) == pytest.approx(multipletests(p_values, method="holm")[1])
    assert holm([]) == []
