"""Which demonstrations a detector learns from, and which are kept aside."""

import numpy as np

from openvima.data.reader import Dataset
from openvima.training.hash_split import lots_of


def split_episodes(dataset: Dataset, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Divide demonstrations into those to learn from and those kept for validation.

    Which ones are kept follows from task and seed alone, so that it stays when data are added.

    Args:
        dataset: The demonstrations.
        share: About so many are kept.

    Returns:
        Numbers of the episodes of both parts.
    """
    lots = lots_of(dataset, "detector/")
    return np.flatnonzero(lots >= share), np.flatnonzero(lots < share)
