"""Chi-square tests of what was drawn, for seeds that are fixed."""

import collections
from collections.abc import Hashable, Iterable, Mapping

_QUANTILE = 3.09  # of the normal distribution at p = 0.001


def assert_frequencies(drawn: Iterable[Hashable], shares: Mapping[Hashable, float]) -> None:
    """Check that values were drawn with the given chances, and no others."""
    counts = collections.Counter(drawn)
    assert set(counts) <= set(shares), f"also drawn: {set(counts) - set(shares)}"
    total = counts.total()
    statistic = sum((counts[value] - total * share) ** 2 / (total * share) for value, share in shares.items())
    assert statistic < _critical(len(shares) - 1), (statistic, dict(counts))


def assert_uniform(drawn: Iterable[Hashable], options: Iterable[Hashable]) -> None:
    """Check that values were drawn with equal chances from the options."""
    options = list(options)
    assert_frequencies(drawn, dict.fromkeys(options, 1 / len(options)))


def _critical(degrees: int) -> float:
    """Value that a chi-square statistic exceeds once in a thousand times (Wilson and Hilferty, 1931)."""
    spread = 2 / (9 * degrees)
    return degrees * (1 - spread + _QUANTILE * spread**0.5) ** 3
