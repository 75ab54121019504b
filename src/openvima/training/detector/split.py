"""Which demonstrations a detector learns from, and which are kept aside."""

import hashlib

import numpy as np

from openvima.data.reader import Dataset


def split_episodes(dataset: Dataset, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Divide demonstrations into those to learn from and those kept for validation.

    Which ones are kept follows from task and seed alone, so that it stays when data are added.

    Args:
        dataset: The demonstrations.
        share: About so many are kept.

    Returns:
        Numbers of the episodes of both parts.
    """
    index = dataset.index
    names = zip(index.column("task").to_pylist(), index.column("seed").to_pylist(), strict=True)
    lots = np.array([_lot(f"{task}/{seed}") for task, seed in names])
    return np.flatnonzero(lots >= share), np.flatnonzero(lots < share)


def _lot(name: str) -> float:
    digest = hashlib.blake2b(f"detector/{name}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") / 2**64
