"""Selecting episodes by a hash of their identity, never by their position.

The selection is the same for any order of the episodes, on every machine, and with or without images.
"""

import hashlib
import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from openvima.errors import ConfigError

_SPLIT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_ROUNDING = 1e-6  # tolerance of the sum of fractions


@dataclass(frozen=True, slots=True)
class Splits:
    """Splits of a data set.

    Args:
        fractions: Name to fraction; the fractions add up to 1.

    Raises:
        ConfigError: They do not, or a name cannot be that of a folder.
    """

    fractions: Mapping[str, float]

    def __post_init__(self) -> None:
        problems = [
            f"split {name!r} needs a name of letters, digits, '_' and '-'."
            for name in self.fractions
            if not _SPLIT_NAME.fullmatch(name)
        ]
        problems += [
            f"split {name!r} has the fraction {fraction}; it must lie between 0 and 1."
            for name, fraction in self.fractions.items()
            if not 0 < fraction < 1
        ]
        total = sum(self.fractions.values())
        if not problems and abs(total - 1) > _ROUNDING:
            problems.append(f"the fractions add up to {total:g}; they must add up to 1.")
        if problems:
            raise ConfigError(" ".join(problems))


def parse_splits(text: str) -> Splits:
    """Parse splits from the command line.

    Args:
        text: Such as "training=0.923,validation=0.077".

    Raises:
        ConfigError: It is not of that form.
    """
    fractions: dict[str, float] = {}
    for entry in text.split(","):
        name, _, fraction = (word.strip() for word in entry.partition("="))
        try:
            number = float(fraction)
        except ValueError:
            raise ConfigError(
                f"splits are {text!r}; give names and fractions such as training=0.923,validation=0.077."
            ) from None
        if name in fractions:
            raise ConfigError(f"split {name!r} is named twice.")
        fractions[name] = number
    return Splits(fractions)


def select_sample(index: pa.Table, fraction: float, seed: int) -> np.ndarray:
    """Select a fraction of the episodes of each task.

    Samples of the same seed are nested.

    Args:
        index: The episodes.
        fraction: Above 0, at most 1; at least one episode of each task is selected.
        seed: Seed of the sample.

    Returns:
        Whether each episode is selected, shape (N,), bool.

    Raises:
        ConfigError: The fraction is out of range.
    """
    if not 0 < fraction <= 1:
        raise ConfigError(f"fraction is {fraction}; it must lie above 0 and not above 1.")
    hashes = _hashes(index, "sample", seed)
    # Where hashes tie, as for one seed in two setups, the content decides.
    tie_breaks = np.array(index.column("content_hash").to_pylist(), dtype=str)
    tasks = np.array(index.column("task").to_pylist(), dtype=str)
    chosen = np.zeros(len(tasks), bool)
    for task in sorted(set(tasks.tolist())):
        of_task = np.flatnonzero(tasks == task)
        order = np.lexsort((tie_breaks[of_task], hashes[of_task]))
        chosen[of_task[order[: max(1, round(fraction * len(of_task)))]]] = True
    return chosen


def assign_splits(index: pa.Table, splits: Splits, seed: int) -> dict[str, np.ndarray]:
    """Assign each episode to a split.

    The assignment is independent of other episodes: it stays when episodes are added, and sizes match the
    fractions approximately.

    Args:
        index: The episodes.
        splits: Names and fractions.
        seed: Seed of the assignment.

    Returns:
        For each split, whether each episode is in it, shape (N,), bool; each episode is in exactly one.
    """
    # Unrelated to the hash of samples; otherwise small samples would all be in the first split.
    places = _hashes(index, "split", seed) / 2.0**64
    bounds = [0.0, *itertools.accumulate(splits.fractions.values())]
    bounds[-1] = np.inf
    return {
        name: (low <= places) & (places < high)
        for name, (low, high) in zip(splits.fractions, itertools.pairwise(bounds), strict=True)
    }


def _hashes(index: pa.Table, purpose: str, seed: int) -> np.ndarray:
    """Hash each episode to 64 bits, shape (N,), uint64."""
    columns = [index.column(name).to_pylist() for name in ("task", "level", "domain", "seed")]
    digests = b"".join(
        hashlib.blake2b("\n".join(map(str, (purpose, seed, *key))).encode(), digest_size=8).digest()
        for key in zip(*columns, strict=True)
    )
    return np.frombuffer(digests, dtype="<u8")
