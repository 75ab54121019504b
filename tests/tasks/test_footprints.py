"""Footprints and kernels of placing."""

import math

import numpy as np
import pytest

from openvima.catalog.packs import load_assets
from openvima.scene import Placement, Pose
from openvima.tasks import sample_episode
from openvima.tasks.kernels import list_free_centres, squared_depths
from openvima.tasks.pushes import Rectangle
from openvima.tasks.table import is_wedged


def test_the_margin_counts_and_a_turned_square_reaches_farther() -> None:
    a = Rectangle(0, 0, 0, 0.015, 0.015)
    for x, near in ((0.0311, False), (0.0309, True), (0.02, True)):
        assert a.comes_near(Rectangle(x, 0.01, math.pi / 2, 0.015, 0.015), 0.001) is near
    assert not a.comes_near(Rectangle(0.035, 0, 0, 0.015, 0.015))
    assert a.comes_near(Rectangle(0.035, 0, math.pi / 4, 0.015, 0.015))


def test_the_box_around_a_turned_square_reaches_farther_than_the_square() -> None:
    spatula = Rectangle(0, 0, 0, 0.0025, 0.025)
    turned = Rectangle(0.02, 0.042, math.pi / 4, 0.015, 0.015)
    assert spatula.meets_box_around(turned) and not spatula.comes_near(turned)
    assert not spatula.meets_box_around(Rectangle(0.02, 0.047, math.pi / 4, 0.015, 0.015))


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


@pytest.mark.parametrize("side", [1, 2, 3, 6, 7])
@pytest.mark.parametrize("num_blots", [0, 1, 6])
def test_free_centres_are_those_of_the_naive_search(side: int, num_blots: int) -> None:
    rng = np.random.default_rng(side * 10 + num_blots)
    for _ in range(4):
        labels = np.zeros((24, 17), np.int16)
        labels[rng.integers(0, 24, num_blots), rng.integers(0, 17, num_blots)] = 5
        centres = np.empty(labels.size, np.int32)
        num_free = list_free_centres(labels, side, np.empty(labels.shape[1], np.int32), centres)
        np.testing.assert_array_equal(centres[:num_free], np.flatnonzero(naive_free_centres(labels, side)))


@pytest.mark.parametrize("density", [0.3, 0.7, 0.95, 1.0])
def test_depths_are_exact_euclidean_distances(density: float) -> None:
    rng = np.random.default_rng(int(100 * density))
    for _ in range(10):
        mask = rng.random((11, 8)) < density
        depths = np.empty((11, 8), np.int32)
        squared_depths(mask, np.empty_like(depths), depths)
        np.testing.assert_array_equal(depths, naive_squared_depths(mask))


@pytest.mark.parametrize(
    ("y", "height_m", "wedged"),
    [(0.07, 0.0, True), (-0.07, 0.0, True), (0.2, 0.0, False), (0.07, 0.04, False)],
)
def test_the_corner_beside_the_handle_of_a_pan_is_not_free(y: float, height_m: float, wedged: bool) -> None:
    pan = Placement(5, "pan", "red", (0.16, 0.24, 0.03), Pose.planar(0.4, 0.0, z=0.0138), fixed=True)
    letter = Placement(6, "letter R", "blue", (0.144, 0.144, 0.036), Pose.planar(0.52, y, z=height_m))
    assert is_wedged(letter, pan, load_assets("procedural")) == wedged


def test_nothing_lies_there_at_levels_beyond_the_published_ones() -> None:
    assets = load_assets("procedural")
    for seed in range(15):
        placements = sample_episode("sort_by_shape", seed=seed, domain="eval").problem.scene.placements
        pairs = [(p, base) for base in placements for p in placements if base.fixed and not p.fixed]
        assert not any(is_wedged(p, base, assets) for p, base in pairs)
