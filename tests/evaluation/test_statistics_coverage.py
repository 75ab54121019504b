"""Whether intervals hold the truth as often as they say, in simulated evaluations with known success rates.

Coverage of a score interval is close to 95 %, not at least 95 %, since counts are whole numbers. The bounds
leave room for that and for three standard errors of the simulation.
"""

import math
from functools import cache

import numpy as np
import pytest

from openvima.evaluation.statistics import (
    PairCounts,
    mcnemar,
    mean_difference,
    mean_of_rates,
    wilson_interval,
)

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
