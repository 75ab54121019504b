"""Prompts drawn for people."""

import numpy as np
import pytest

from openvima.scene import RenderedPrompt
from openvima.video.prompt_strip import draw_prompt_strip, prompt_pieces, thumbnail

GREEN, RED = (0, 200, 0), (200, 0, 0)


def columns_of(strip: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return np.flatnonzero((strip == colour).all(axis=2).any(axis=0))


def rows_of(strip: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    return np.flatnonzero((strip == colour).all(axis=2).any(axis=1))


def test_pieces_are_words_and_images_in_reading_order(prompt):
    pieces = prompt_pieces(prompt)
    assert [piece if isinstance(piece, str) else piece.name for piece in pieces] == [
        "Put",
        "the",
        "a",
        "into",
        "the",
        "b",
        ".",
    ]


def test_pictures_stand_in_reading_order_on_one_wide_line(prompt):
    strip = draw_prompt_strip(prompt, width=768)
    assert columns_of(strip, GREEN).max() < columns_of(strip, RED).min()
    assert rows_of(strip, GREEN).min() < rows_of(strip, RED).max()


def test_a_narrow_strip_wraps_and_nothing_is_cut_off(prompt):
    wide, narrow = draw_prompt_strip(prompt, width=768), draw_prompt_strip(prompt, width=200)
    assert narrow.shape[0] > wide.shape[0]
    assert rows_of(narrow, GREEN).max() < rows_of(narrow, RED).min()
    for colour in (GREEN, RED):
        assert len(columns_of(narrow, colour)) == len(columns_of(wide, colour))


def test_a_picture_wider_than_the_strip_is_scaled_down(prompt):
    strip = draw_prompt_strip(prompt, width=60)
    assert strip.shape[1] == 60
    assert columns_of(strip, RED).max() < 60 - 2


@pytest.mark.parametrize("width", [60, 200, 333, 768])
def test_strips_have_the_asked_width_and_an_even_height(prompt, width):
    strip = draw_prompt_strip(prompt, width=width)
    assert strip.dtype == np.uint8
    assert strip.shape[1:] == (width, 3)
    assert strip.shape[0] % 2 == 0


def test_strips_of_equal_prompts_are_equal(prompt):
    assert np.array_equal(draw_prompt_strip(prompt, width=500), draw_prompt_strip(prompt, width=500))


def test_a_full_stop_stays_with_the_picture_before_it(prompt):
    for width in range(150, 420, 9):
        strip = draw_prompt_strip(prompt, width=width)
        ink = (strip < 60).all(axis=2)
        below = ink[rows_of(strip, RED).max() + 12 :]
        assert not below.any(), f"the full stop went to a line of its own at width {width}"


def test_pictures_of_objects_are_cut_to_the_object(prompt):
    picture = np.asarray(thumbnail(prompt.images["a"], height=76))
    coloured = (picture == GREEN).all(axis=2).mean()
    assert picture.shape[0] == 76
    assert coloured > 0.5


def test_pictures_of_scenes_are_shown_whole(prompt):
    image = prompt.images["a"]
    scene = type(image)("s", "scene", image.rgb, image.segm, image.objects)
    assert thumbnail(scene, height=64).size == (128, 64)


def test_an_object_that_fills_the_picture_to_its_border_is_drawn(prompt):
    image = prompt.images["a"]
    full = np.zeros((3, 128, 256), np.uint8)
    whole = type(image)("s", "object", {"front": full}, {"front": full[0]}, image.objects)
    assert thumbnail(whole, height=64).height == 64


def test_a_prompt_of_words_only_is_one_line():
    strip = draw_prompt_strip(RenderedPrompt("Do nothing.", {}), width=400)
    assert strip.shape[0] < 60
