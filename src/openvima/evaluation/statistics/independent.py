"""Difference and ratio of two independent means, from each mean and its interval."""

import math

from openvima.evaluation.statistics.score import Interval

Estimated = tuple[float, Interval]


def difference_of_means(a: Estimated, b: Estimated) -> Estimated:
    """Difference of two independent means.

    Args:
        a: Mean and its interval.
        b: Mean and its interval, of other episodes, at the same confidence.

    Returns:
        a minus b, and its interval.

    Example:
        >>> value, interval = difference_of_means((0.7, (0.57, 0.81)), (0.4, (0.28, 0.53)))
        >>> round(value, 2), [round(end, 2) for end in interval]
        (0.3, [0.12, 0.46])

    Source: method of variance estimates recovery, Zou and Donner 2008; for two rates with Wilson's intervals
        it is Newcombe's method 10.
    """
    (mean_a, (low_a, high_a)), (mean_b, (low_b, high_b)) = a, b
    value = mean_a - mean_b
    low = value - math.hypot(mean_a - low_a, high_b - mean_b)
    high = value + math.hypot(high_a - mean_a, mean_b - low_b)
    return value, (max(-1.0, low), min(1.0, high))


def ratio_of_means(a: Estimated, b: Estimated) -> Estimated | None:
    """Ratio of two independent means that are not negative.

    Args:
        a: Mean and its interval.
        b: Mean and its interval, of other episodes, at the same confidence.

    Returns:
        a divided by b, and its interval; None where b is too close to 0 for a bounded one.

    Source: MOVER-R, Donner and Zou 2012.
    """
    (mean_a, (low_a, high_a)), (mean_b, (low_b, high_b)) = a, b
    if low_b <= 0 or high_b >= 2 * mean_b:
        return None
    product = mean_a * mean_b
    down, up = high_b * (2 * mean_b - high_b), low_b * (2 * mean_b - low_b)
    low = (product - math.sqrt(max(0.0, product**2 - low_a * (2 * mean_a - low_a) * down))) / down
    high = (product + math.sqrt(max(0.0, product**2 - high_a * (2 * mean_a - high_a) * up))) / up
    return mean_a / mean_b, (max(0.0, low), high)
