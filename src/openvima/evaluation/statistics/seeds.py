"""Means over training seeds, with the variation of seeds apart from the noise of episodes.

Each seed is a training of its own, evaluated on episodes of its own, so that the means of the seeds are
independent and their variance holds both sources: var(mean of a seed) = var(training) + var(episodes).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from openvima.errors import ConfigError
from openvima.evaluation.statistics.paired import PairCounts, mean_difference
from openvima.evaluation.statistics.proportions import mean_of_rates
from openvima.evaluation.statistics.score import Interval, quantile

_HALVINGS = 60
Counts = Sequence[tuple[int, int]]


@dataclass(frozen=True, slots=True)
class SeedMean:
    """Mean success rate over training seeds, as fractions.

    Args:
        mean: Unweighted mean over seeds and tasks.
        interval: 95 % interval that holds both the variation of seeds and the noise of episodes.
        seeds: Mean of each seed, and its interval from episodes alone.
        sd: Standard deviation of the means of the seeds; None with one seed.
        episode_sd: Standard deviation that the noise of episodes alone gives the mean of a seed.
        training_sd: What remains: the standard deviation between trainings; None with one seed.
    """

    mean: float
    interval: Interval
    seeds: tuple[tuple[float, Interval], ...]
    sd: float | None
    episode_sd: float
    training_sd: float | None


def mean_over_seeds(counts: Sequence[Counts], confidence: float = 0.95) -> SeedMean:
    """Average the success rates of several trainings.

    The interval spans two: Student's of the means of the seeds, whose variance holds both sources, and the
    score interval of all episodes, which alone is left where every seed has the same mean, as at 0 and 100 %.
    With one seed it is the latter, and says nothing on other seeds.

    Args:
        counts: For each seed (successes, episodes) of each task, tasks in the same order.
        confidence: Nominal coverage, between 0 and 1.

    Raises:
        ConfigError: There is no seed, the seeds differ in their tasks, or counts are impossible.

    Source: variance components of a one-way random-effects model, S. R. Searle et al., "Variance Components",
        1992; Student's interval, "Student", 1908. Seeds apart from test noise: X. Bouthillier et al.,
        "Accounting for variance in machine learning benchmarks", 2021.
    """
    if not counts or len({len(of_seed) for of_seed in counts}) > 1:
        raise ConfigError("seeds must be evaluated on the same tasks, and there must be one at least.")
    seeds = tuple(mean_of_rates(of_seed, confidence) for of_seed in counts)
    pooled = [(sum(s for s, _ in task), sum(n for _, n in task)) for task in zip(*counts, strict=True)]
    mean, interval = mean_of_rates(pooled, confidence)
    means = [seed for seed, _ in seeds]
    episode_variance = sum(map(_episode_variance, counts)) / len(counts)
    sd = _sd(means)
    low, high = _spanning(interval, _student_interval(means, confidence))
    training_sd = None if sd is None else math.sqrt(max(0.0, sd * sd - episode_variance))
    return SeedMean(
        mean, (max(0.0, low), min(1.0, high)), seeds, sd, math.sqrt(episode_variance), training_sd
    )


def difference_over_seeds(
    pairs: Sequence[Sequence[PairCounts]], confidence: float = 0.95
) -> tuple[float, Interval]:
    """Average the difference of two success rates over seeds, each pair evaluated on the same episodes.

    Args:
        pairs: For each seed the outcomes on each task, tasks in the same order.
        confidence: Nominal coverage, between 0 and 1.

    Returns:
        The mean of a minus b, and its interval: that of `mean_difference` over all episodes, widened to
        Student's interval of the differences of the seeds.
    """
    pooled = [
        PairCounts(*(sum(getattr(p, name) for p in task) for name in PairCounts.__slots__))
        for task in zip(*pairs, strict=True)
    ]
    difference, interval = mean_difference(pooled, confidence)
    each = [sum(p.difference for p in of_seed) / len(of_seed) for of_seed in pairs]
    low, high = _spanning(interval, _student_interval(each, confidence))
    return difference, (max(-1.0, low), min(1.0, high))


def student_quantile(confidence: float, degrees: int) -> float:
    """Two-sided quantile of Student's t distribution.

    Args:
        confidence: Between 0 and 1.
        degrees: Degrees of freedom, at least 1.

    Example:
        >>> round(student_quantile(0.95, 2), 3)
        4.303

    Source: finite series of the distribution, Abramowitz and Stegun, 26.7.3 and 26.7.4.
    """
    quantile(confidence)  # checks it
    low, high = 0.0, math.pi / 2
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if _within(middle, degrees) < confidence else (low, middle)
    return math.tan(low) * math.sqrt(degrees)


def _within(angle: float, degrees: int) -> float:
    """Probability of |t| <= tan(angle) sqrt(degrees)."""
    odd = degrees % 2
    term = math.cos(angle) if odd else 1.0
    total = 0.0
    for power in range(odd, degrees - 1, 2):  # of the cosine
        total += term
        term *= math.cos(angle) ** 2 * (power + 1) / (power + 2)
    total *= math.sin(angle)
    return 2 / math.pi * (angle + total) if odd else total


def _student_interval(values: Sequence[float], confidence: float) -> Interval | None:
    sd = _sd(values)
    if sd is None:
        return None
    mean = sum(values) / len(values)
    half = student_quantile(confidence, len(values) - 1) * sd / math.sqrt(len(values))
    return mean - half, mean + half


def _spanning(interval: Interval, other: Interval | None) -> Interval:
    if other is None:
        return interval
    return min(interval[0], other[0]), max(interval[1], other[1])


def _sd(values: Sequence[float]) -> float | None:
    if len(values) < 2:
        return None
    mean = sum(values) / len(values)
    return math.sqrt(sum((value - mean) ** 2 for value in values) / (len(values) - 1))


def _episode_variance(counts: Counts) -> float:
    """Unbiased variance of the mean of one seed over its tasks, from episodes alone."""
    each = [s / n * (1 - s / n) / max(1, n - 1) for s, n in counts]
    return sum(each) / len(each) ** 2
