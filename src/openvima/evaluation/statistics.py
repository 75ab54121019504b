"""How sure a success rate is: interval estimates for proportions and for means of proportions."""

import math
from collections.abc import Sequence
from statistics import NormalDist

from openvima.errors import ConfigError

Interval = tuple[float, float]


def wilson_interval(successes: int, episodes: int, confidence: float = 0.95) -> Interval:
    """Interval in which the true success rate lies, from counts.

    Unlike the usual ± interval it stays inside [0, 1] and is of use at 0 and at 100 % success.

    Args:
        successes: Episodes that were solved.
        episodes: Episodes that were played, at least one.
        confidence: Share of such intervals that hold the true rate, between 0 and 1.

    Returns:
        Lower and upper end, as fractions.

    Raises:
        ConfigError: The counts or the confidence cannot be.

    Example:
        >>> [round(end, 3) for end in wilson_interval(8, 10)]
        [0.49, 0.943]

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """
    if episodes < 1 or not 0 <= successes <= episodes or not 0 < confidence < 1:
        raise ConfigError(
            f"no interval for {successes} successes in {episodes} episodes at confidence {confidence}; "
            "episodes must be at least 1, successes 0 … episodes, the confidence between 0 and 1."
        )
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
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

    The distances from each rate to the ends of its own Wilson interval are added in squares, which keeps the
    interval honest where rates are near 0 or 1.

    Args:
        counts: (successes, episodes) of each task.
        confidence: As for `wilson_interval`.

    Returns:
        The mean and its interval, as fractions.

    Raises:
        ConfigError: There are no counts, or impossible ones.

    Source: the "square-and-add" method, Newcombe 1998; Zou and Donner 2008.
    """
    if not counts:
        raise ConfigError("the mean of no success rates is undefined; give at least one pair of counts.")
    rates = [successes / episodes if episodes else 0.0 for successes, episodes in counts]
    intervals = [wilson_interval(successes, episodes, confidence) for successes, episodes in counts]
    mean = sum(rates) / len(rates)
    below = math.sqrt(sum((r - low) ** 2 for r, (low, _) in zip(rates, intervals, strict=True)))
    above = math.sqrt(sum((high - r) ** 2 for r, (_, high) in zip(rates, intervals, strict=True)))
    return mean, (max(0.0, mean - below / len(rates)), min(1.0, mean + above / len(rates)))
