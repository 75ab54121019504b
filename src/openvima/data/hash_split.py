"""Splits of demonstrations: a hash of task and seed decides."""

import hashlib

import numpy as np
import pyarrow as pa


def split_hashes(index: pa.Table, purpose: str = "") -> np.ndarray:
    """Return a uniform number between 0 and 1 for each demonstration, shape (N,), float64.

    It follows from its task and seed alone, so that it stays when data are added.

    Args:
        index: Of the demonstrations: `Dataset.index`.
        purpose: Other purposes have other numbers.
    """
    names = zip(index.column("task").to_pylist(), index.column("seed").to_pylist(), strict=True)
    return np.array([_hash(f"{purpose}{task}/{seed}") for task, seed in names], np.float64)


def _hash(name: str) -> float:
    digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") / 2**64
