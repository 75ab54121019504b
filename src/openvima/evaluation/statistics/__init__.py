"""Confidence intervals and tests of rates and differences, from counts."""

from openvima.evaluation.statistics.multiple import holm
from openvima.evaluation.statistics.paired import PairCounts, mcnemar, mean_difference
from openvima.evaluation.statistics.proportions import mean_of_rates, wilson_interval
from openvima.evaluation.statistics.score import Interval

__all__ = ["Interval", "PairCounts", "holm", "mcnemar", "mean_difference", "mean_of_rates", "wilson_interval"]
