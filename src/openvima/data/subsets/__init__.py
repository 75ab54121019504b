"""Data sets derived from others: sample, split and merge."""

from openvima.data.subsets.choosing import Splits, parse_splits
from openvima.data.subsets.merging import MergeConfig, merge
from openvima.data.subsets.sampling import SubsetConfig, sample, split

__all__ = ["MergeConfig", "Splits", "SubsetConfig", "merge", "parse_splits", "sample", "split"]
