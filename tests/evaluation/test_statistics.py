"""Intervals of rates: against published values, libraries and slow twins; seeds, pairs, what must hold."""

import math
from functools import cache
from itertools import product

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from openvima.evaluation.statistics import (
    PairCounts,
    difference_over_seeds,
    holm,
    mcnemar,
    mean_difference,
    mean_of_rates,
    mean_over_seeds,
    student_quantile,
    wilson_interval,
)


@pytest.mark.parametrize(
    ("successes", "episodes", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),  # the worked examples of Newcombe 1998, table I, method 3
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
        (29, 29, 0.8830, 1.0000),
    ],
)
def test_wilson_interval_gives_published_values(successes, episodes, low, high):
    assert wilson_interval(successes, episodes) == pytest.approx((low, high), abs=6e-5)


def test_wilson_interval_ends_exactly_at_zero_and_one():
    for episodes in (1, 7, 50, 200, 1000):
        assert wilson_interval(0, episodes)[0] == 0.0
        assert wilson_interval(episodes, episodes)[1] == 1.0


def test_mean_of_one_rate_is_that_rate_with_its_own_interval():
    mean, interval = mean_of_rates([(8, 10)])
    assert mean == 0.8
    assert interval == pytest.approx(wilson_interval(8, 10))


def test_mean_of_rates_weighs_tasks_alike_whatever_their_episodes():
    mean, _ = mean_of_rates([(10, 10), (0, 1000)])
    assert mean == 0.5


def test_student_quantiles_are_those_of_scipy() -> None:
    stats = pytest.importorskip("scipy.stats")
    for degrees, confidence in product((1, 2, 3, 4, 7, 30), (0.5, 0.95, 0.999)):
        expected = stats.t.ppf(0.5 + confidence / 2, degrees)
        assert student_quantile(confidence, degrees) == pytest.approx(expected, rel=1e-9)


def test_one_seed_has_the_interval_of_its_episodes() -> None:
    counts = [(40, 50), (10, 50)]
    found = mean_over_seeds([counts])
    assert (found.mean, found.interval) == mean_of_rates(counts)


def test_several_seeds_have_students_interval_where_it_is_wider() -> None:
    found = mean_over_seeds([[(20, 100)], [(50, 100)], [(80, 100)]])
    half = 4.302653 * 0.3 / 3**0.5
    assert found.interval == pytest.approx((max(0, 0.5 - half), min(1, 0.5 + half)), abs=1e-6)


def test_equal_seeds_keep_the_interval_of_all_episodes() -> None:
    found = mean_over_seeds([[(50, 50)]] * 3)
    assert found.interval == mean_of_rates([(150, 150)])[1]


def test_a_difference_over_seeds_spans_pooled_episodes_and_seeds() -> None:
    pairs = [[PairCounts(10, 30, 5, 5)], [PairCounts(10, 10, 25, 5)], [PairCounts(10, 20, 15, 5)]]
    difference, interval = difference_over_seeds(pairs)
    pooled = mean_difference([PairCounts(30, 60, 45, 15)])
    assert difference == pytest.approx(pooled[0])
    assert interval[0] < pooled[1][0] and interval[1] > pooled[1][1]


@pytest.mark.parametrize(("rate", "training_sd"), [(0.97, 0.02), (0.5, 0.15)])
def test_intervals_over_three_seeds_cover_the_mean_of_all_trainings(rate: float, training_sd: float) -> None:
    rng = np.random.default_rng(7)
    true_mean = np.clip(rate + training_sd * rng.standard_normal(100_000), 0, 1).mean()
    trainings = np.clip(rate + training_sd * rng.standard_normal((120, 3)), 0, 1)
    intervals = [
        mean_over_seeds([[(s, 50)] for s in found]).interval for found in rng.binomial(50, trainings)
    ]
    assert sum(low <= true_mean <= high for low, high in intervals) >= 0.93 * len(intervals)


COUNTS = st.builds(PairCounts, *[st.integers(0, 30)] * 4).filter(lambda counts: counts.episodes)


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
    for only_a, only_b in [(0, 1), (1, 7), (7, 1), (5, 5), (12, 30), (200, 260), (0, 40), (3000, 3600)]:
        expected = mcnemar_of([[3, only_a], [only_b, 4]], exact=True).pvalue
        assert mcnemar(only_a, only_b)[0] == pytest.approx(expected, rel=1e-9)
    assert mcnemar(0, 0) == (1.0, 0.5)


def test_mid_p_is_the_tail_with_half_of_what_was_observed():
    binom = pytest.importorskip("scipy.stats").binom
    for only_a, only_b in [(0, 1), (1, 7), (12, 30), (300, 260)]:
        fewer, tosses = min(only_a, only_b), only_a + only_b
        expected = 2 * (binom.cdf(fewer - 1, tosses, 0.5) + binom.pmf(fewer, tosses, 0.5) / 2)
        assert mcnemar(only_a, only_b)[1] == pytest.approx(expected, rel=1e-9)


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


@given(st.lists(COUNTS, min_size=1, max_size=5))
@example([PairCounts(5, 0, 0, 0)])
@example([PairCounts(0, 5, 0, 0)])
@example([PairCounts(0, 0, 0, 5)])
def test_swapping_the_policies_mirrors_the_interval(counts):
    difference, (low, high) = mean_difference(counts)
    assert -1 <= low <= difference <= high <= 1
    assert high - low > 0.1 or sum(each.episodes for each in counts) > 9
    mirrored, interval = mean_difference([PairCounts(both, b, a, neither) for both, a, b, neither in counts])
    assert mirrored == -difference
    assert interval == pytest.approx((-high, -low), abs=1e-9)


@pytest.mark.slow
def test_holm_agrees_with_statsmodels():
    multipletests = pytest.importorskip("statsmodels.stats.multitest").multipletests
    for p_values in ([0.01, 0.04, 0.03], [0.2], [0.5, 0.9, 0.001, 0.001, 0.02], [1.0, 1.0]):
        assert holm(p_values) == pytest.approx(multipletests(p_values, method="holm")[1])
    assert holm([]) == []


# Success rates of a strong policy by task, some tasks at their limit; and of one that hardly ever succeeds.
STRONG = (1.0, 0.995, 0.565, 1.0, 0.18, 0.77, 0.93, 0.97, 0.43)
WEAK = (0.02,) * 9
NEARLY_PERFECT = (0.97,) * 9
SIMULATIONS = 300
LEAST, MOST = 0.95 - 3 * 0.0126, 0.995


def is_inside(truth: float, interval: tuple[float, float]) -> bool:
    return interval[0] - 1e-12 <= truth <= interval[1] + 1e-12


@pytest.mark.parametrize("episodes", [10, 50, 200])
def test_wilson_intervals_cover_the_truth_at_their_rate_on_average(episodes):
    covered = []
    for truth in np.linspace(0.01, 0.99, 99):  # exact: all outcomes with their probabilities
        chances = [
            math.comb(episodes, k) * truth**k * (1 - truth) ** (episodes - k) for k in range(episodes + 1)
        ]
        covered.append(sum(p for k, p in enumerate(chances) if is_inside(truth, wilson(k, episodes))))
    assert np.mean(covered) == pytest.approx(0.95, abs=0.01)
    assert min(covered) > 0.83  # the known dip of Wilson's interval next to 0 and 1


@cache
def wilson(successes: int, episodes: int) -> tuple[float, float]:
    return wilson_interval(successes, episodes)


@pytest.mark.parametrize("episodes", [8, 50])
@pytest.mark.parametrize("rates", [STRONG, WEAK, NEARLY_PERFECT])
@pytest.mark.slow
def test_intervals_of_level_means_cover_the_truth_at_their_rate(rates, episodes):
    rng = np.random.default_rng(episodes)
    hits = 0
    for solved in rng.binomial(episodes, rates, size=(SIMULATIONS, len(rates))):
        _, interval = mean_of_rates([(int(number), episodes) for number in solved])
        hits += is_inside(float(np.mean(rates)), interval)
    assert LEAST < hits / SIMULATIONS <= MOST


@pytest.mark.parametrize(("a", "b"), [(0.9, 0.9), (0.8, 0.6), (0.4, 0.5)])
def test_intervals_of_one_paired_difference_cover_the_truth_at_their_rate(a, b):
    episodes, only_b = 16, 0.05
    only_a = only_b + a - b
    coverage = 0.0
    for x in range(episodes + 1):  # exact, as above
        for y in range(episodes + 1 - x):
            rest = episodes - x - y
            chance = math.comb(episodes, x) * math.comb(episodes - x, y)
            chance *= max(only_a, 0.03) ** x * max(only_b, 0.03 - a + b) ** y
            chance *= (1 - max(only_a, 0.03) - max(only_b, 0.03 - a + b)) ** rest
            _, interval = mean_difference([PairCounts(rest, x, y, 0)])
            coverage += chance * is_inside(a - b, interval)
    assert 0.93 < coverage <= 1


def test_mcnemars_test_raises_no_more_false_alarms_than_it_says():
    rng = np.random.default_rng(7)
    rates = np.array([0.9, 0.7, 0.5, 0.2])
    alarms = np.zeros(2)
    for _ in range(1000):
        counts = paired_outcomes(rng, rates, rates, 20)
        pooled = mcnemar(sum(c.only_a for c in counts), sum(c.only_b for c in counts))
        alarms += np.array(pooled) < 0.05
    assert alarms[0] / 1000 <= 0.05
    assert alarms[0] <= alarms[1] <= 70


def paired_outcomes(
    rng: np.random.Generator, a: np.ndarray, b: np.ndarray, episodes: int
) -> list[PairCounts]:
    """Outcomes of two policies with given success rates that find the same episodes hard."""
    hardness = rng.random((episodes, len(a)))
    own = rng.random((episodes, len(a)))
    solved_a = hardness < a
    solved_b = np.where(rng.random((episodes, len(a))) < 0.6, hardness, own) < b
    return [
        PairCounts(*(int(np.sum(x)) for x in (p & q, p & ~q, ~p & q, ~p & ~q)))
        for p, q in zip(solved_a.T, solved_b.T, strict=True)
    ]
