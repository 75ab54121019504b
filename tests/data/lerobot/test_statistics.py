"""Statistics of an episode and of all episodes."""

import numpy as np
import pytest

from openvima.data.lerobot_files import QUANTILES, count_pixels, pixel_statistics, value_statistics


def smallest_not_exceeded_by(values: np.ndarray, share: float) -> float:
    """The definition of a quantile, taken literally."""
    return min(v for v in values if np.mean(values <= v) >= share)


@pytest.mark.parametrize("length", [1, 2, 7, 100])
def test_numbers_get_the_statistics_of_numpy(length: int) -> None:
    values = np.random.default_rng(length).normal(size=(length, 2)).astype(np.float32)
    found = value_statistics(values)
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(found[name], getattr(np, name)(values.astype(np.float64), axis=0))
    for name, share in QUANTILES.items():
        expected = [smallest_not_exceeded_by(column, share) for column in values.T]
        np.testing.assert_array_equal(found[name], expected)
    assert found["count"].tolist() == [length]


def test_the_extremes_of_truth_values_are_truth_values() -> None:
    found = value_statistics(np.array([False, False, True]))
    assert (found["min"].tolist(), found["max"].tolist()) == ([False], [True])
    assert found["mean"] == pytest.approx(1 / 3)


def test_pictures_get_the_statistics_of_their_pixels_by_channel() -> None:
    pictures = np.random.default_rng(0).integers(20, 200, (3, 3, 4, 8), dtype=np.uint8)
    found = pixel_statistics(count_pixels(pictures, 3), 3)
    for channel in range(3):
        pixels = pictures[:, channel].reshape(-1) / 255
        for name in ("min", "max", "mean", "std"):
            assert found[name][channel, 0, 0] == pytest.approx(getattr(np, name)(pixels), abs=1e-12)
        for name, share in QUANTILES.items():
            assert found[name][channel, 0, 0] == smallest_not_exceeded_by(pixels, share)
    assert found["mean"].shape == (3, 1, 1)
    assert found["count"].tolist() == [3]


def test_one_picture_counts_for_each_frame_that_shows_it() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (1, 3, 4, 8), dtype=np.uint8)
    often = np.repeat(picture, 5, axis=0)
    np.testing.assert_array_equal(count_pixels(picture, 5), count_pixels(often, 5))
