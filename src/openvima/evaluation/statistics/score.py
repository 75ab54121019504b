"""Score intervals: all values of a quantity that a test based on the data would not reject.

Each value is judged with the variance that it would itself imply, so that intervals keep their promise near
0 and 100 %, where the usual "estimate ± 1.96 standard errors" collapses. The fits that a value implies form a
family with one parameter, a Lagrange multiplier, along which the end of the interval is searched.
"""

from collections.abc import Callable, Sequence
from statistics import NormalDist

from openvima.errors import ConfigError

Interval = tuple[float, float]
Fit = Callable[[float], tuple[float, float]]

_HALVINGS = 36  # of the range of multipliers; ends are then exact to about 1e-10


def quantile(confidence: float) -> float:
    """Standard normal quantile of a two-sided interval.

    Raises:
        ConfigError: The confidence is not between 0 and 1.
    """
    if not 0 < confidence < 1:
        raise ConfigError(f"the confidence is {confidence}; it must lie between 0 and 1, such as 0.95.")
    return NormalDist().inv_cdf(0.5 + confidence / 2)


def lower_end(estimate: float, fit: Fit, z: float) -> float:
    """Find the lower end of a score interval.

    Args:
        estimate: The quantity's estimate without constraint; above the least possible value.
        fit: Gives for a multiplier above 0 the quantity under the constrained fit, and the variance of its
            estimate there. The larger the multiplier, the smaller the quantity.
        z: Standard errors between the end and the estimate.

    Returns:
        The value that lies `z` of its own standard errors below the estimate.
    """

    def is_inside(multiplier: float) -> bool:
        value, variance = fit(multiplier)
        return (estimate - value) ** 2 <= z * z * variance

    inside, outside = 0.0, 1.0
    while is_inside(outside):
        inside, outside = outside, 2 * outside
    for _ in range(_HALVINGS):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if is_inside(middle) else (inside, middle)
    return fit(outside)[0]


def mean_and_variance(fitted: Sequence[tuple[float, float]], played: Sequence[int]) -> tuple[float, float]:
    """Unweighted mean over tasks, and the variance of its estimate.

    With one number fitted to each of k tasks and one constraint over all, k - 1 numbers follow the data and
    make the fitted variances too small, by (k - 1) / k episodes of each task.

    Args:
        fitted: Mean and variance of a single episode, for each task.
        played: Episodes of each task.
    """
    num_tasks = len(played)
    mean = sum(value for value, _ in fitted) / num_tasks
    spread = sum(v / (n - 1 + 1 / num_tasks) for (_, v), n in zip(fitted, played, strict=True))
    return mean, spread / num_tasks**2
