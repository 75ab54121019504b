"""Parts of data sets, and data sets put together: sample, split and merge."""

from openvima.data.subsets.choosing import Parts, parse_parts
from openvima.data.subsets.merging import MergeConfig, merge
from openvima.data.subsets.sampling import SubsetConfig, sample, split

__all__ = ["MergeConfig", "Parts", "SubsetConfig", "merge", "parse_parts", "sample", "split"]
