"""Interval estimates against published values."""

import pytest

from openvima.errors import ConfigError
from openvima.evaluation.statistics import mean_of_rates, wilson_interval


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


def test_wilson_interval_is_mirrored_when_successes_and_failures_swap():
    low, high = wilson_interval(37, 200)
    assert wilson_interval(163, 200) == pytest.approx((1 - high, 1 - low), abs=1e-12)


def test_wilson_interval_ends_exactly_at_zero_and_one():
    for episodes in (1, 7, 50, 200, 1000):
        assert wilson_interval(0, episodes)[0] == 0.0
        assert wilson_interval(episodes, episodes)[1] == 1.0


def test_higher_confidence_widens_the_interval():
    narrow, wide = wilson_interval(5, 10, 0.8), wilson_interval(5, 10, 0.99)
    assert wide[0] < narrow[0] < 0.5 < narrow[1] < wide[1]


@pytest.mark.parametrize("counts", [(1, 0), (-1, 5), (6, 5)])
def test_impossible_counts_are_refused(counts):
    with pytest.raises(ConfigError, match="no interval for"):
        wilson_interval(*counts)


def test_mean_of_one_rate_is_that_rate_with_its_own_interval():
    mean, interval = mean_of_rates([(8, 10)])
    assert mean == 0.8
    assert interval == pytest.approx(wilson_interval(8, 10))


def test_mean_of_rates_weighs_tasks_alike_whatever_their_episodes():
    mean, _ = mean_of_rates([(10, 10), (0, 1000)])
    assert mean == 0.5


def test_mean_of_rates_narrows_with_more_tasks():
    _, one = mean_of_rates([(25, 50)])
    _, four = mean_of_rates([(25, 50)] * 4)
    assert four[1] - four[0] == pytest.approx((one[1] - one[0]) / 2, rel=0.05)


def test_mean_of_no_rates_is_refused():
    with pytest.raises(ConfigError, match="at least one"):
        mean_of_rates([])
