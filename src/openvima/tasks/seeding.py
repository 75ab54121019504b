"""Independent random generators for each domain, task, level, seed and purpose."""

import functools
import hashlib
from typing import Literal, get_args

import numpy as np

from openvima.errors import ConfigError, unknown_name

Domain = Literal["train", "eval", "user"]
DOMAINS: tuple[Domain, ...] = get_args(Domain)

MAX_SEED = 2**63 - 1
_WORD = 2**32


def make_rng(
    domain: str, task: str, level: str, seed: int, purpose: str, *, attempt: int = 0
) -> np.random.Generator:
    """Return the generator of one purpose of one episode.

    Args:
        domain: "train", "eval" or "user"; equal seeds of two domains give unrelated generators.
        task: Name of the task.
        level: "train" or "L1" to "L4".
        seed: The episode's number, 0 … 2⁶³ − 1.
        purpose: Use of the draws, such as "scene", "ids" or "oracle"; purposes are independent.
        attempt: Number of the redraw, 0 for the first try.

    Returns:
        A fresh generator; equal arguments give equal draws on every machine.

    Raises:
        ConfigError: The domain is unknown, or the seed is negative, too large or not an integer.
    """
    if domain not in DOMAINS:
        raise ConfigError(unknown_name("seed domain", domain, DOMAINS))
    number = checked_seed(seed)
    words = [word for name in (domain, task, level, purpose) for word in _name_words(name)]
    entropy = [*words, attempt, number % _WORD, number // _WORD]  # fixed length, so no two keys coincide
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(entropy)))


def checked_seed(seed: object) -> int:
    """Return the seed as a plain integer.

    Raises:
        ConfigError: It is negative, above 2⁶³ − 1 or not an integer.
    """
    if isinstance(seed, bool) or not isinstance(seed, int | np.integer):
        raise ConfigError(f"seed is {seed!r} ({type(seed).__name__}); give an integer from 0 to 2**63 - 1.")
    if not 0 <= seed <= MAX_SEED:
        raise ConfigError(f"seed is {seed}; give an integer from 0 to 2**63 - 1.")
    return int(seed)


@functools.lru_cache(maxsize=256)
def _name_words(name: str) -> tuple[int, int]:
    """Two 32-bit words of a stable hash of a name."""
    digest = hashlib.sha256(name.encode("utf-8")).digest()
    return int.from_bytes(digest[:4], "little"), int.from_bytes(digest[4:8], "little")
