"""Confidence intervals and tests of rates and differences, from counts."""

from openvima.evaluation.statistics.independent import difference_of_means, ratio_of_means
from openvima.evaluation.statistics.multiple import holm
from openvima.evaluation.statistics.paired import PairCounts, mcnemar, mean_difference
from openvima.evaluation.statistics.proportions import mean_of_rates, wilson_interval
from openvima.evaluation.statistics.score import Interval
from openvima.evaluation.statistics.seeds import SeedMean, difference_over_seeds, mean_over_seeds

__all__ = [
    "Interval",
    "PairCounts",
    "SeedMean",
    "difference_of_means",
    "difference_over_seeds",
    "holm",
    "mcnemar",
    "mean_difference",
    "mean_of_rates",
    "mean_over_seeds",
    "ratio_of_means",
    "wilson_interval",
]
