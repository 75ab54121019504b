"""Procedural pictures: layouts, mean colours, and the same bits everywhere."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from openvima.catalog.images import draw_texture, hash_numbers, value_noise
from openvima.catalog.textures import TEXTURES, texture_spec

DIGESTS = Path(__file__).parents[1] / "golden" / "procedural_textures.json"
MEAN_TOLERANCE = 15  # levels of 255, per channel


@pytest.fixture(scope="module")
def images():
    return {name: draw_texture(name) for name in TEXTURES}


def digests(images):
    return {name: hashlib.sha256(image.tobytes()).hexdigest()[:16] for name, image in images.items()}


@pytest.mark.slow
def test_all_textures_are_images_of_bytes(images):
    for name, image in images.items():
        assert image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3, name
        assert image.flags.c_contiguous
        assert (image.shape == (1, 1, 3)) == (texture_spec(name).colour is not None)


def test_no_two_textures_look_the_same(images):
    assert len(set(digests(images).values())) == len(TEXTURES)


def test_textures_are_the_same_bits_as_when_they_were_recorded(images):
    # After a deliberate change: PYTHONPATH=tests/catalog python -c "import test_images; test_images.record()"
    assert digests(images) == json.loads(DIGESTS.read_text())


def record():
    current = digests({name: draw_texture(name) for name in TEXTURES})
    DIGESTS.write_text(json.dumps(current, indent=1) + "\n")


def test_stripes_start_with_the_first_colour_and_change_twenty_times(images):
    row = images["red and yellow stripe"][100].astype(int)
    assert tuple(row[0]) == texture_spec("red").texel
    assert tuple(row[-1]) == texture_spec("yellow").texel
    assert np.count_nonzero(np.abs(np.diff(row, axis=0)).sum(axis=1)) == 19


def test_dots_cover_a_fifth_in_the_first_colour(images):
    image = images["blue and purple polka dot"]
    share = (image == texture_spec("blue").texel).all(axis=2).mean()
    assert share == pytest.approx(0.2, abs=0.02)


def test_a_dark_swirl_darkens_the_rays_and_leaves_the_ground_white(images):
    light, dark = images["green swirl"], images["dark green swirl"]
    rays = (light == texture_spec("green").texel).all(axis=2)
    assert rays.mean() == pytest.approx(0.5, abs=0.03)
    assert (dark[rays] == texture_spec("dark green").texel).all()
    assert (dark[~rays] == 255).all() and (light[~rays] == 255).all()


def test_the_checkerboard_starts_light(images):
    image = images["checkerboard"]
    assert image[10, 10].mean() > 150 > image[10, 60].mean()


def test_mean_colours_are_near_those_of_the_benchmark(images, catalogue):
    for record in catalogue["textures"]:
        if record["kind"] == "image":
            mean = images[record["name"]].reshape(-1, 3).mean(axis=0)
            assert np.abs(mean - record["mean_rgb"]).max() < MEAN_TOLERANCE, record["name"]


def test_hashed_numbers_are_spread_evenly_over_the_unit_interval():
    numbers = hash_numbers(np.arange(200)[:, None], np.arange(200)[None, :], seed=3)
    assert numbers.min() >= 0 and numbers.max() < 1
    counts, _ = np.histogram(numbers, bins=10, range=(0, 1))
    assert counts == pytest.approx(4000, rel=0.06)


def test_noise_continues_across_the_borders():
    noise = value_noise((64, 64), (4, 4), seed=5)
    inner_step = np.abs(np.diff(noise, axis=0)).max()
    assert np.abs(noise[0] - noise[-1]).max() <= inner_step
