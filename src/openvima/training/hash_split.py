"""Which demonstrations are kept for validation: what falls to them by lot, once and for all."""

import hashlib

import numpy as np

from openvima.data.reader import Dataset


def lots_of(dataset: Dataset, purpose: str = "") -> np.ndarray:
    """Return a number between 0 and 1 for each demonstration, shape (N,), float64.

    It follows from its task and seed alone, so that it stays when data are added.

    Args:
        dataset: The demonstrations.
        purpose: Other purposes have other lots.
    """
    index = dataset.index
    names = zip(index.column("task").to_pylist(), index.column("seed").to_pylist(), strict=True)
    return np.array([_lot(f"{purpose}{task}/{seed}") for task, seed in names], np.float64)


def _lot(name: str) -> float:
    digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") / 2**64
