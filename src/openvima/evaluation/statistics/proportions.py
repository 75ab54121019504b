"""Confidence intervals for success rates and for means of several."""

import math
from collections.abc import Sequence

from openvima.errors import ConfigError
from openvima.evaluation.statistics.score import Interval, lower_end, mean_and_variance, quantile


def wilson_interval(successes: int, episodes: int, confidence: float = 0.95) -> Interval:
    """Confidence interval of a success rate.

    Unlike the normal approximation it stays inside [0, 1] and is valid at 0 and 100 % success.

    Args:
        successes: Solved episodes.
        episodes: All episodes, at least one.
        confidence: Nominal coverage, between 0 and 1.

    Returns:
        Lower and upper end, as fractions.

    Raises:
        ConfigError: The counts or the confidence cannot be.

    Example:
        >>> [round(end, 3) for end in wilson_interval(8, 10)]
        [0.49, 0.943]

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """
    _check(successes, episodes)
    z = quantile(confidence)
    rate = successes / episodes
    shrink = 1 + z * z / episodes
    centre = (rate + z * z / (2 * episodes)) / shrink
    half = z / shrink * math.sqrt(rate * (1 - rate) / episodes + z * z / (4 * episodes**2))
    # at 0 and at all successes one end is exactly the rate; rounding must not push it past
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == episodes else min(1.0, centre + half)
    return low, high


def mean_of_rates(counts: Sequence[tuple[int, int]], confidence: float = 0.95) -> tuple[float, Interval]:
    """Unweighted mean of several success rates, with an interval.

    The interval is Wilson's, carried over to a mean: it holds every mean that lies within z standard errors
    of the observed one, these taken from the rates that are most likely if that were the true mean. For one
    task it is Wilson's interval itself.

    Args:
        counts: (successes, episodes) of each task.
        confidence: As for `wilson_interval`.

    Returns:
        The mean and its interval, as fractions.

    Raises:
        ConfigError: There are no counts, or impossible ones.

    Source: score method for linear combinations of proportions, Martín Andrés et al. 2011. Adding the tasks'
        own Wilson intervals in squares is simpler, but covers too rarely near 0 and 100 %: see
        docs/reports.md.
    """
    if not counts:
        raise ConfigError("the mean of no success rates is undefined; give at least one pair of counts.")
    for successes, episodes in counts:
        _check(successes, episodes)
    z = quantile(confidence)
    mean = sum(successes / episodes for successes, episodes in counts) / len(counts)
    failures = [(episodes - successes, episodes) for successes, episodes in counts]
    return mean, (_lowest_mean(counts, z), 1 - _lowest_mean(failures, z))


def _lowest_mean(counts: Sequence[tuple[int, int]], z: float) -> float:
    """Lower end of the interval of a mean."""
    estimate = sum(successes / episodes for successes, episodes in counts) / len(counts)
    if estimate <= 0:
        return 0.0
    played = [episodes for _, episodes in counts]

    def fit(multiplier: float) -> tuple[float, float]:
        rates = [_most_likely(*count, multiplier) for count in counts]
        return mean_and_variance([(rate, rate * (1 - rate)) for rate in rates], played)

    return lower_end(estimate, fit, z)


def _most_likely(successes: int, episodes: int, multiplier: float) -> float:
    """Most likely rate of a task, given the mean of all.

    It is the rate p with `(successes - episodes p) / (p (1 - p)) = multiplier`, the same for all tasks.
    """
    total = multiplier + episodes
    return 2 * successes / (total + math.sqrt(total * total - 4 * multiplier * successes))


def _check(successes: int, episodes: int) -> None:
    if episodes < 1 or not 0 <= successes <= episodes:
        raise ConfigError(
            f"no interval for {successes} successes in {episodes} episodes; there must be at least 1 episode "
            "and 0 to that many successes."
        )
