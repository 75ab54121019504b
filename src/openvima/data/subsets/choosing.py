"""Which episodes belong to a subset: decided by a hash of what names an episode, never by its place.

So the choice is the same whatever the order of the episodes, on every machine, and for data written with or
without images.
"""

import hashlib
import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from openvima.errors import ConfigError

_PART_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_ROUNDING = 1e-6  # by which shares may miss 1


@dataclass(frozen=True, slots=True)
class Parts:
    """Names of the parts of a data set and their shares.

    Args:
        shares: Name to share; the shares add up to 1.

    Raises:
        ConfigError: They do not, or a name cannot be that of a folder.
    """

    shares: Mapping[str, float]

    def __post_init__(self) -> None:
        problems = [
            f"part {name!r} needs a name of letters, digits, '_' and '-'."
            for name in self.shares
            if not _PART_NAME.fullmatch(name)
        ]
        problems += [
            f"part {name!r} has the share {share}; it must lie between 0 and 1."
            for name, share in self.shares.items()
            if not 0 < share < 1
        ]
        total = sum(self.shares.values())
        if not problems and abs(total - 1) > _ROUNDING:
            problems.append(f"the shares add up to {total:g}; they must make 1.")
        if problems:
            raise ConfigError(" ".join(problems))


def parse_parts(text: str) -> Parts:
    """Read parts as they are given on the command line.

    Args:
        text: Such as "training=0.923,validation=0.077".

    Raises:
        ConfigError: It is not of that form.
    """
    shares: dict[str, float] = {}
    for entry in text.split(","):
        name, _, share = (word.strip() for word in entry.partition("="))
        try:
            number = float(share)
        except ValueError:
            raise ConfigError(
                f"parts are {text!r}; give names and shares such as training=0.923,validation=0.077."
            ) from None
        if name in shares:
            raise ConfigError(f"part {name!r} is named twice.")
        shares[name] = number
    return Parts(shares)


def chosen_sample(index: pa.Table, share: float, seed: int) -> np.ndarray:
    """Choose a share of the episodes of each task.

    A smaller share of the same seed is always part of a larger one.

    Args:
        index: The episodes.
        share: Above 0, at most 1; at least one episode of each task is chosen.
        seed: Another one gives another choice.

    Returns:
        Whether each episode is chosen, shape (N,), bool.

    Raises:
        ConfigError: The share is out of range.
    """
    if not 0 < share <= 1:
        raise ConfigError(f"share is {share}; it must lie above 0 and not above 1.")
    hashes = _hashes(index, "sample", seed)
    # Where hashes tie, as for one seed in two setups, the content decides.
    tie_breaks = np.array(index.column("content_hash").to_pylist(), dtype=str)
    tasks = np.array(index.column("task").to_pylist(), dtype=str)
    chosen = np.zeros(len(tasks), bool)
    for task in sorted(set(tasks.tolist())):
        of_task = np.flatnonzero(tasks == task)
        order = np.lexsort((tie_breaks[of_task], hashes[of_task]))
        chosen[of_task[order[: max(1, round(share * len(of_task)))]]] = True
    return chosen


def chosen_parts(index: pa.Table, parts: Parts, seed: int) -> dict[str, np.ndarray]:
    """Divide the episodes.

    Each one is drawn into its part by itself, so it stays there whatever episodes are added, and the sizes
    come close to the shares without meeting them.

    Args:
        index: The episodes.
        parts: Names and shares.
        seed: Another one gives another division.

    Returns:
        For each part, whether each episode is in it, shape (N,), bool; each episode is in exactly one.
    """
    # Another purpose than that of samples: else small samples would lie in the first part altogether.
    places = _hashes(index, "split", seed) / 2.0**64
    bounds = [0.0, *itertools.accumulate(parts.shares.values())]
    bounds[-1] = np.inf
    return {
        name: (low <= places) & (places < high)
        for name, (low, high) in zip(parts.shares, itertools.pairwise(bounds), strict=True)
    }


def _hashes(index: pa.Table, purpose: str, seed: int) -> np.ndarray:
    """A number for each episode, spread evenly over 64 bits, shape (N,), uint64."""
    columns = [index.column(name).to_pylist() for name in ("task", "level", "domain", "seed")]
    digests = b"".join(
        hashlib.blake2b("\n".join(map(str, (purpose, seed, *key))).encode(), digest_size=8).digest()
        for key in zip(*columns, strict=True)
    )
    return np.frombuffer(digests, dtype="<u8")
