"""Confidence intervals and tests of rates and differences, from counts.

Score intervals hold all values of a quantity that a test based on the data would not reject. Each value is
judged with the variance that it would itself imply, so that intervals keep their promise near 0 and 100 %,
where the usual "estimate ± 1.96 standard errors" collapses. The fits that a value implies form a family with
one parameter, a Lagrange multiplier, along which the end of the interval is searched.

Means over training seeds: each seed is a training of its own, evaluated on episodes of its own, so that the
means of the seeds are independent and their variance holds both sources: var(mean of a seed) = var(training)
+ var(episodes).
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from statistics import NormalDist, fmean, stdev
from typing import NamedTuple, TypeVar

Interval = tuple[float, float]
Counts = Sequence[tuple[int, int]]  # (successes, episodes) of each task
C = TypeVar("C")  # outcomes on one task

_CONFIDENCE = 0.95
_HALVINGS = 36  # of the range of multipliers; ends are then exact to about 1e-10
_Z = NormalDist().inv_cdf(0.5 + _CONFIDENCE / 2)


def _lower_end(
    estimate: float,
    least: float,
    counts: Sequence[C],
    played: Sequence[int],
    likely: Callable[[C, float], tuple[float, float]],
) -> float:
    """Find the lower end of a score interval for an unweighted mean over tasks.

    With one number fitted to each of k tasks and one constraint over all, k - 1 numbers follow the data and
    make the fitted variances too small, by (k - 1) / k episodes of each task.

    Args:
        estimate: The mean without constraint.
        least: The least possible one.
        counts: Outcomes on each task.
        played: Episodes of each task.
        likely: Gives for a task's outcomes and a multiplier above 0 the constrained fit: mean and variance of
            a single episode. The larger the multiplier, the smaller the mean.

    Returns:
        The value that lies `_Z` of its own standard errors below the estimate.
    """
    if estimate <= least:
        return least
    num_tasks = len(played)

    def constrained(multiplier: float) -> tuple[float, float]:
        fitted = [likely(count, multiplier) for count in counts]
        mean = sum(value for value, _ in fitted) / num_tasks
        spread = sum(v / (n - 1 + 1 / num_tasks) for (_, v), n in zip(fitted, played, strict=True))
        return mean, spread / num_tasks**2

    def is_inside(multiplier: float) -> bool:
        value, variance = constrained(multiplier)
        return (estimate - value) ** 2 <= _Z * _Z * variance

    inside, outside = 0.0, 1.0
    while is_inside(outside):
        inside, outside = outside, 2 * outside
    for _ in range(_HALVINGS):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if is_inside(middle) else (inside, middle)
    return constrained(outside)[0]


def wilson_interval(successes: int, episodes: int) -> Interval:
    """95 % confidence interval of a success rate.

    Unlike the normal approximation it stays inside [0, 1] and is valid at 0 and 100 % success.

    Args:
        successes: Solved episodes.
        episodes: All episodes, at least one.

    Returns:
        Lower and upper end, as fractions.

    Example:
        >>> [round(end, 3) for end in wilson_interval(8, 10)]
        [0.49, 0.943]

    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference", 1927.
    """
    z = _Z
    rate = successes / episodes
    shrink = 1 + z * z / episodes
    centre = (rate + z * z / (2 * episodes)) / shrink
    half = z / shrink * math.sqrt(rate * (1 - rate) / episodes + z * z / (4 * episodes**2))
    # at 0 and at all successes one end is exactly the rate; rounding must not push it past
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == episodes else min(1.0, centre + half)
    return low, high


def mean_of_rates(counts: Counts) -> tuple[float, Interval]:
    """Unweighted mean of several success rates, with a 95 % interval.

    The interval is Wilson's, carried over to a mean: it holds every mean that lies within z standard errors
    of the observed one, these taken from the rates that are most likely if that were the true mean. For one
    task it is Wilson's interval itself.

    Args:
        counts: (successes, episodes) of each task.

    Returns:
        The mean and its interval, as fractions.

    Source: score method for linear combinations of proportions, Martín Andrés et al. 2011. Adding the tasks'
        own Wilson intervals in squares is simpler, but covers too rarely near 0 and 100 %: see
        docs/reports.md.
    """
    failures = [(episodes - successes, episodes) for successes, episodes in counts]
    played = [episodes for _, episodes in counts]
    low, lost = (_lower_end(_mean_rate(each), 0.0, each, played, _likely_rate) for each in (counts, failures))
    return _mean_rate(counts), (low, 1 - lost)


def _mean_rate(counts: Counts) -> float:
    return sum(successes / episodes for successes, episodes in counts) / len(counts)


def _likely_rate(count: tuple[int, int], multiplier: float) -> tuple[float, float]:
    """Most likely rate of a task, given the mean of all, and its variance.

    It is the rate p with `(successes - episodes p) / (p (1 - p)) = multiplier`, the same for all tasks.
    """
    successes, episodes = count
    total = multiplier + episodes
    rate = 2 * successes / (total + math.sqrt(total * total - 4 * multiplier * successes))
    return rate, rate * (1 - rate)


_NEWTON_STEPS = 60  # it needs about 8; more only where an end is nearly -1 or 1
_CONVERGED = 1e-12


class PairCounts(NamedTuple):
    """Outcomes of two policies, a and b, on the same episodes.

    Args:
        both: Episodes that both solved.
        only_a: Episodes that a solved and b did not.
        only_b: Episodes that b solved and a did not.
        neither: Episodes that neither solved.
    """

    both: int
    only_a: int
    only_b: int
    neither: int

    @classmethod
    def of(cls, outcomes: Iterable[tuple[bool, bool]]) -> "PairCounts":
        """Count the outcomes of a and b, success or not, of each episode."""
        pairs = Counter(outcomes)
        return cls(pairs[True, True], pairs[True, False], pairs[False, True], pairs[False, False])

    @classmethod
    def sum(cls, counts: "Iterable[PairCounts]") -> "PairCounts":
        """Add the counts of several tasks or seeds."""
        return cls(*map(sum, zip(*counts, strict=True)))

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return sum(self)

    @property
    def difference(self) -> float:
        """Success rate of a minus that of b."""
        return (self.only_a - self.only_b) / self.episodes


def mean_difference(counts: Sequence[PairCounts]) -> tuple[float, Interval]:
    """Unweighted mean over tasks of the differences of two success rates on the same episodes.

    For one task the 95 % interval is Tango's. For several it holds every mean difference that lies within z
    standard errors of the observed one, these taken from the probabilities that are most likely if that were
    the true one.

    Args:
        counts: Outcomes on each task.

    Returns:
        The mean of a minus b, and its interval, as fractions.

    Example:
        >>> difference, interval = mean_difference([PairCounts(1, 1, 7, 12)])
        >>> round(difference, 3), [round(end, 3) for end in interval]
        (-0.286, [-0.517, -0.026])

    Source: T. Tango, "Equivalence test and confidence interval for the difference in proportions for the
        paired-sample design", 1998; for several tasks the same principle with one constraint over all.
    """
    swapped = [PairCounts(both, only_b, only_a, neither) for both, only_a, only_b, neither in counts]
    played = [count.episodes for count in counts]
    low, lost = (
        _lower_end(_mean_of_differences(each), -1.0, each, played, _likely_pair) for each in (counts, swapped)
    )
    return _mean_of_differences(counts), (low, -lost)


def mcnemar(only_a: int, only_b: int) -> tuple[float, float]:
    """Test whether two policies solve equally many of the same episodes.

    If they did, each episode that only one of them solved would be a toss of a fair coin. Counts of several
    tasks may be added: the test then asks whether the two are alike on every task.

    Args:
        only_a: Episodes that a solved and b did not.
        only_b: Episodes that b solved and a did not.

    Returns:
        The exact p-value, two-sided; and the mid-p-value, which counts the observed outcome half. The exact
        one errs at most as often as it says, the other about as often as it says.

    Example:
        >>> [round(p, 4) for p in mcnemar(1, 7)]
        [0.0703, 0.0391]

    Source: Q. McNemar 1947; mid-p: Fagerland, Lydersen and Laake 2013.
    """
    tosses, fewer = only_a + only_b, min(only_a, only_b)
    ways = math.comb(tosses, fewer)  # to toss so many heads; whole numbers, hence exact
    tail = sum(math.comb(tosses, heads) for heads in range(fewer + 1))
    everything = 2**tosses
    if only_a == only_b:
        return 1.0, 1 - ways / (2 * everything)
    return 2 * tail / everything, (2 * tail - ways) / everything


def _mean_of_differences(counts: Sequence[PairCounts]) -> float:
    return sum(count.difference for count in counts) / len(counts)


def _likely_pair(counts: PairCounts, multiplier: float) -> tuple[float, float]:
    """Most likely difference of two rates on a task, given the mean difference, and its variance.

    With A and B for the probabilities that only a, and that only b solves an episode, and C for the rest, the
    optimum has `only_a / A = s + multiplier`,
    `only_b / B = s - multiplier` and `same / C = s` for a number s of each task, such that A + B + C = 1.
    Where only_b is 0, s may be as small as the multiplier, and B takes what A and C leave.

    Args:
        counts: Outcomes on one task.
        multiplier: Above 0, the same for all tasks; the larger, the smaller is A - B.

    Returns:
        A - B and the variance of a single episode.
    """
    same = counts.both + counts.neither
    # The sum falls with s and is convex; each of these bounds makes one term 1, so no step of Newton's
    # overshoots.
    s = max(same, counts.only_a - multiplier, counts.only_b + multiplier)
    for _ in range(_NEWTON_STEPS):
        a, c = counts.only_a / (s + multiplier), same / s
        b = counts.only_b / (s - multiplier) if counts.only_b else 0.0
        slope = a / (s + multiplier) + c / s + (b / (s - multiplier) if b else 0.0)
        step = (a + b + c - 1) / slope if slope else 0.0
        if step <= _CONVERGED * s:
            break
        s += step
    a = counts.only_a / (s + multiplier)
    b = min(1.0, max(0.0, 1 - a - same / s))
    return a - b, max(0.0, a + b - (a - b) ** 2)


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values to control the family-wise error rate.

    Args:
        p_values: Of the single tests, in any order; the tests may depend on each other.

    Returns:
        Adjusted p-values in the same order.

    Example:
        >>> holm([0.01, 0.04, 0.03])
        [0.03, 0.06, 0.06]

    Source: S. Holm, "A simple sequentially rejective multiple test procedure", 1979.
    """
    adjusted = [0.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


_QUANTILE_HALVINGS = 60


@dataclass(frozen=True, slots=True)
class SeedMean:
    """Mean success rate over training seeds, as fractions.

    Args:
        mean: Unweighted mean over seeds and tasks.
        interval: 95 % interval that holds both the variation of seeds and the noise of episodes.
        seeds: Mean of each seed, and its interval from episodes alone.
    """

    mean: float
    interval: Interval
    seeds: tuple[tuple[float, Interval], ...]


def mean_over_seeds(counts: Sequence[Counts]) -> SeedMean:
    """Average the success rates of several trainings.

    The interval spans two: Student's of the means of the seeds, whose variance holds both sources, and the
    score interval of all episodes, which alone is left where every seed has the same mean, as at 0 and 100 %.
    With one seed it is the latter, and says nothing on other seeds.

    Args:
        counts: For each seed those of each task, tasks in the same order.

    Source: Student's interval, "Student", 1908. Seeds apart from test noise: X. Bouthillier et al.,
        "Accounting for variance in machine learning benchmarks", 2021.
    """
    seeds = tuple(map(mean_of_rates, counts))
    pooled = [(sum(s for s, _ in task), sum(n for _, n in task)) for task in zip(*counts, strict=True)]
    mean, interval = mean_of_rates(pooled)
    return SeedMean(mean, _widen(interval, [seed for seed, _ in seeds], least=0.0), seeds)


def difference_over_seeds(pairs: Sequence[Sequence[PairCounts]]) -> tuple[float, Interval]:
    """Average the difference of two success rates over seeds, each pair evaluated on the same episodes.

    Args:
        pairs: For each seed the outcomes on each task, tasks in the same order.

    Returns:
        The mean of a minus b, and its interval: that of `mean_difference` over all episodes, widened to
        Student's interval of the differences of the seeds.
    """
    pooled = [PairCounts.sum(task) for task in zip(*pairs, strict=True)]
    difference, interval = mean_difference(pooled)
    return difference, _widen(interval, list(map(_mean_of_differences, pairs)), least=-1.0)


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
    low, high = 0.0, math.pi / 2
    for _ in range(_QUANTILE_HALVINGS):
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


def _widen(interval: Interval, values: Sequence[float], *, least: float) -> Interval:
    """Widen an interval to Student's of the values of several seeds, between `least` and 1."""
    if len(values) < 2:
        return interval
    mean = fmean(values)
    half = student_quantile(_CONFIDENCE, len(values) - 1) * stdev(values) / math.sqrt(len(values))
    return max(least, min(interval[0], mean - half)), min(1.0, max(interval[1], mean + half))
