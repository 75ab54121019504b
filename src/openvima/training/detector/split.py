"""Training and validation split of a detector's demonstrations."""

import numpy as np

from openvima.data.hash_split import split_hashes
from openvima.data.reader import Dataset


def split_episodes(dataset: Dataset, fraction: float) -> tuple[np.ndarray, np.ndarray]:
    """Split demonstrations into training and validation.

    The split follows from task and seed, so that it stays the same when data are added.

    Args:
        dataset: The demonstrations.
        fraction: Fraction to hold out.

    Returns:
        Indices of both.
    """
    hashes = split_hashes(dataset.index, "detector/")
    return np.flatnonzero(hashes >= fraction), np.flatnonzero(hashes < fraction)
