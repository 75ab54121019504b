"""Paired comparison of two policies: difference of success rates, and McNemar's test."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from openvima.errors import ConfigError
from openvima.evaluation.statistics.score import Interval, lower_end, mean_and_variance, quantile

_NEWTON_STEPS = 60  # it needs about 8; more only where an end is nearly -1 or 1
_CONVERGED = 1e-12


@dataclass(frozen=True, slots=True)
class PairCounts:
    """Outcomes of two policies, a and b, on the same episodes.

    Args:
        both: Episodes that both solved.
        only_a: Episodes that a solved and b did not.
        only_b: Episodes that b solved and a did not.
        neither: Episodes that neither solved.

    Raises:
        ConfigError: There is no episode, or a count is negative.
    """

    both: int
    only_a: int
    only_b: int
    neither: int

    def __post_init__(self) -> None:
        if self.episodes < 1 or min(self.both, self.only_a, self.only_b, self.neither) < 0:
            raise ConfigError(
                f"{self} cannot be compared; counts are at least 0, and one episode must have been played."
            )

    @classmethod
    def of(cls, outcomes: Iterable[tuple[bool, bool]]) -> "PairCounts":
        """Count the outcomes of a and b, success or not, of each episode."""
        pairs = list(outcomes)
        return cls(
            *(pairs.count(pair) for pair in ((True, True), (True, False), (False, True), (False, False)))
        )

    @property
    def episodes(self) -> int:
        """Number of episodes."""
        return self.both + self.only_a + self.only_b + self.neither

    @property
    def swapped(self) -> "PairCounts":
        """The same outcomes with a and b exchanged."""
        return PairCounts(self.both, self.only_b, self.only_a, self.neither)

    @property
    def difference(self) -> float:
        """Success rate of a minus that of b."""
        return (self.only_a - self.only_b) / self.episodes


def mean_difference(counts: Sequence[PairCounts], confidence: float = 0.95) -> tuple[float, Interval]:
    """Unweighted mean over tasks of the differences of two success rates on the same episodes.

    For one task the interval is Tango's. For several it holds every mean difference that lies within z
    standard errors of the observed one, these taken from the probabilities that are most likely if that were
    the true one.

    Args:
        counts: Outcomes on each task.
        confidence: Nominal coverage, between 0 and 1.

    Returns:
        The mean of a minus b, and its interval, as fractions.

    Raises:
        ConfigError: There are no counts, or the confidence cannot be.

    Example:
        >>> difference, interval = mean_difference([PairCounts(1, 1, 7, 12)])
        >>> round(difference, 3), [round(end, 3) for end in interval]
        (-0.286, [-0.517, -0.026])

    Source: T. Tango, "Equivalence test and confidence interval for the difference in proportions for the
        paired-sample design", 1998; for several tasks the same principle with one constraint over all.
    """
    if not counts:
        raise ConfigError("the mean of no differences is undefined; give the counts of at least one task.")
    z = quantile(confidence)
    difference = sum(count.difference for count in counts) / len(counts)
    return difference, (_lowest_difference(counts, z), -_lowest_difference([c.swapped for c in counts], z))


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
    if min(only_a, only_b) < 0:
        raise ConfigError(f"counts of episodes are at least 0, got {only_a} and {only_b}.")
    tosses, fewer = only_a + only_b, min(only_a, only_b)
    ways, tail = 1, 1  # to toss `index` heads, and at most that many; whole numbers, hence exact
    for index in range(1, fewer + 1):
        ways = ways * (tosses - index + 1) // index
        tail += ways
    everything = 2**tosses
    if only_a == only_b:
        return 1.0, 1 - ways / (2 * everything)
    return 2 * tail / everything, (2 * tail - ways) / everything


def _lowest_difference(counts: Sequence[PairCounts], z: float) -> float:
    """Lower end of the interval of a mean difference."""
    estimate = sum(count.difference for count in counts) / len(counts)
    if estimate <= -1:
        return -1.0
    played = [count.episodes for count in counts]

    def fit(multiplier: float) -> tuple[float, float]:
        likely = [_most_likely(count, multiplier) for count in counts]
        return mean_and_variance([(a - b, max(0.0, a + b - (a - b) ** 2)) for a, b in likely], played)

    return lower_end(estimate, fit, z)


def _most_likely(counts: PairCounts, multiplier: float) -> tuple[float, float]:
    """Most likely probabilities that only a, and that only b solves an episode, given the mean difference.

    With A and B for these and C for the rest, the optimum has `only_a / A = s + multiplier`,
    `only_b / B = s - multiplier` and `same / C = s` for a number s of each task, such that A + B + C = 1.
    Where only_b is 0, s may be as small as the multiplier, and B takes what A and C leave.

    Args:
        counts: Outcomes on one task.
        multiplier: Above 0, the same for all tasks; the larger, the smaller is A - B.

    Returns:
        A and B.
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
    return a, min(1.0, max(0.0, 1 - a - same / s))
