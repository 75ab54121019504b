"""Which demonstrations a detector is trained on, and which are held out."""

import numpy as np

from openvima.data.reader import Dataset
from openvima.training.hash_split import split_hashes


def split_episodes(dataset: Dataset, fraction: float) -> tuple[np.ndarray, np.ndarray]:
    """Split demonstrations into those to train on and held-out ones.

    Which ones are held out follows from task and seed, so that it stays when data are added.

    Args:
        dataset: The demonstrations.
        fraction: Fraction to hold out.

    Returns:
        Indices of both.
    """
    hashes = split_hashes(dataset, "detector/")
    return np.flatnonzero(hashes >= fraction), np.flatnonzero(hashes < fraction)
