"""The compiled raster loops agree with slow, obvious ones."""

import numpy as np
import pytest

from openvima.tasks.kernels import mark_free_centres, nth_centre, squared_depths


def naive_free_centres(labels: np.ndarray, side: int) -> np.ndarray:
    num_rows, num_columns = labels.shape
    free = labels == 0
    free[[0, -1], :] = False
    free[:, [0, -1]] = False
    centres = np.zeros(labels.shape, np.uint8)
    low, high = side // 2, (side - 1) - side // 2  # an even window reaches one cell farther to the low side
    for row in range(low, num_rows - high):
        for column in range(low, num_columns - high):
            window = free[row - low : row + high + 1, column - low : column + high + 1]
            centres[row, column] = window.shape == (side, side) and window.all()
    return centres


def naive_squared_depths(mask: np.ndarray) -> np.ndarray:
    padded = np.pad(mask, 1)
    outside = np.argwhere(~padded)
    depths = np.zeros(mask.shape, np.int32)
    for row, column in np.argwhere(mask):
        depths[row, column] = ((outside - (row + 1, column + 1)) ** 2).sum(axis=1).min()
    return depths


def free_centres(labels: np.ndarray, side: int) -> tuple[int, np.ndarray, np.ndarray]:
    centres = np.full(labels.shape, 7, np.uint8)
    counts = np.full(len(labels), 7, np.int32)
    num_free = mark_free_centres(labels, side, np.empty(labels.shape[1], np.int32), centres, counts)
    return num_free, centres, counts


@pytest.mark.parametrize("side", [1, 2, 3, 6, 7])
@pytest.mark.parametrize("num_blots", [0, 1, 6])
def test_free_centres_are_those_of_the_naive_search(side: int, num_blots: int) -> None:
    rng = np.random.default_rng(side * 10 + num_blots)
    for _ in range(10):
        labels = np.zeros((24, 17), np.int16)
        labels[rng.integers(0, 24, num_blots), rng.integers(0, 17, num_blots)] = 5
        num_free, centres, counts = free_centres(labels, side)
        expected = naive_free_centres(labels, side)
        np.testing.assert_array_equal(centres, expected)
        np.testing.assert_array_equal(counts, expected.sum(axis=1))
        assert num_free == expected.sum()


def test_an_even_window_is_one_cell_longer_towards_the_low_side() -> None:
    labels = np.zeros((20, 20), np.int16)
    labels[10, 10] = 5
    centres = free_centres(labels, 4)[1]
    assert not centres[9, 10] and not centres[12, 10]  # windows of rows 7–10 and 10–13
    assert centres[8, 10] and centres[13, 10]


def test_centres_keep_half_a_window_from_the_edge() -> None:
    num_free, centres, _ = free_centres(np.zeros((320, 160), np.int16), 58)
    rows, columns = np.nonzero(centres)
    assert (rows.min(), columns.min()) == (30, 30)
    assert (rows.max(), columns.max()) == (318 - 28, 158 - 28)
    assert num_free == len(rows)


def test_a_window_larger_than_the_raster_fits_nowhere() -> None:
    assert free_centres(np.zeros((20, 20), np.int16), 19)[0] == 0


def test_centres_are_counted_row_by_row() -> None:
    labels = np.zeros((12, 9), np.int16)
    labels[5, 4] = 5
    num_free, centres, counts = free_centres(labels, 3)
    listed = [nth_centre(centres, counts, index) for index in range(num_free)]
    assert listed == [tuple(cell) for cell in np.argwhere(centres).tolist()]


@pytest.mark.parametrize("density", [0.3, 0.7, 0.95, 1.0])
def test_depths_are_exact_euclidean_distances(density: float) -> None:
    rng = np.random.default_rng(int(100 * density))
    for _ in range(10):
        mask = rng.random((11, 8)) < density
        labels = np.full((15, 12), 3, np.int16)
        labels[2:13, 3:11][mask] = 6
        depths = np.empty((11, 8), np.int32)
        squared_depths(labels, 6, 2, 3, np.empty_like(depths), depths)
        np.testing.assert_array_equal(depths, naive_squared_depths(mask))
