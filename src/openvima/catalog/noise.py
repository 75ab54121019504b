"""Noise for textures from integer hashing: bit-identical on every machine and with every NumPy version."""

import numpy as np


def hashed(*coordinates: np.ndarray | int, seed: int) -> np.ndarray:
    """Return a number in [0, 1) for each combination of whole numbers.

    Args:
        *coordinates: Arrays of non-negative integers, broadcast against each other.
        seed: Seed of the hash.

    Returns:
        float64, multiples of 2⁻³².

    Source: the mixing steps of SplitMix64 (Steele, Lea and Flood, 2014).
    """
    state = np.asarray(seed, dtype=np.uint64)
    with np.errstate(over="ignore"):  # overflow is intended
        for coordinate in coordinates:
            state = _mixed(state * np.uint64(31) + np.asarray(coordinate).astype(np.uint64) + np.uint64(1))
    return (state >> np.uint64(32)).astype(np.float64) / 2.0**32


def _mixed(state: np.ndarray) -> np.ndarray:
    state = state * np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


def value_noise(shape: tuple[int, int], cells: tuple[int, int], seed: int) -> np.ndarray:
    """Return smooth noise in [0, 1) that continues across opposite borders.

    Args:
        shape: Rows and columns of the image.
        cells: Number of random values down and across, between which the noise changes smoothly.
        seed: Seed of the noise.
    """
    rows, columns = (np.arange(n) * c / n for n, c in zip(shape, cells, strict=True))
    top, left = rows.astype(np.int64), columns.astype(np.int64)
    down, right = _smooth(rows - top)[:, None], _smooth(columns - left)[None, :]

    def lattice(row_shift: int, column_shift: int) -> np.ndarray:
        row, column = (top + row_shift) % cells[0], (left + column_shift) % cells[1]
        return hashed(row[:, None], column[None, :], seed=seed)

    above = lattice(0, 0) * (1 - right) + lattice(0, 1) * right
    below = lattice(1, 0) * (1 - right) + lattice(1, 1) * right
    return above * (1 - down) + below * down


def layered_noise(shape: tuple[int, int], cells: tuple[int, int], seed: int, num_layers: int) -> np.ndarray:
    """Return fractal noise in [0, 1): layers of doubled frequency and halved amplitude."""
    total, weight_sum = np.zeros(shape), 0.0
    for layer in range(num_layers):
        weight = 0.5**layer
        total += weight * value_noise(shape, (cells[0] << layer, cells[1] << layer), seed + layer)
        weight_sum += weight
    return total / weight_sum


def _smooth(t: np.ndarray) -> np.ndarray:
    return t * t * (3 - 2 * t)
