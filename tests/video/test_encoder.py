"""Videos and the strip of their prompts."""

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import pytest

from openvima.errors import ShapeError
from openvima.scene import RenderedPrompt
from openvima.video.encoder import open_video
from openvima.video.prompt_strip import draw_prompt_strip, prompt_pieces, thumbnail
from small_data_sets import frames_of


def plain(colour: tuple[int, int, int], height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


def write_video(path: Path, frames: Sequence[np.ndarray]) -> Path:
    with open_video(path, frames[0].shape[1], frames[0].shape[0], frames_per_second=30) as write_frame:
        for frame in frames:
            write_frame(frame)
    return path


def test_frames_come_back_in_order_with_their_colours(tmp_path):
    colours = [(220, 30, 30), (30, 200, 40), (30, 40, 210)]
    path = write_video(tmp_path / "video.mp4", [plain(colour) for colour in colours for _ in range(5)])
    frames = frames_of(path)
    assert len(frames) == 15
    for index, colour in enumerate(colours):
        assert np.abs(frames[5 * index + 2].mean(axis=(0, 1)) - colour).max() < 6


def test_videos_suit_browsers(tmp_path):
    path = write_video(tmp_path / "video.mp4", [plain((9, 9, 9))] * 30)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate == 30
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), "the index must come first"


def test_a_frame_can_be_repeated(tmp_path):
    with open_video(tmp_path / "still.mp4", 64, 48, frames_per_second=30) as write_frame:
        write_frame(plain((1, 2, 3)), repeat=7)
    assert len(frames_of(tmp_path / "still.mp4")) == 7


def test_odd_sizes_are_refused_before_a_file_is_made(tmp_path):
    with pytest.raises(ShapeError, match="even"):
        write_video(tmp_path / "odd.mp4", [plain((0, 0, 0), height=47)])
    assert not list(tmp_path.iterdir())


def test_an_interrupted_video_leaves_the_earlier_one(tmp_path):
    path = write_video(tmp_path / "video.mp4", [plain((9, 9, 9))] * 3)
    whole = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), open_video(path, 64, 48, frames_per_second=30) as write_frame:
        write_frame(plain((200, 9, 9)))
        raise KeyboardInterrupt
    assert path.read_bytes() == whole
    assert list(tmp_path.iterdir()) == [path]


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
    assert narrow.shape[0] > wide.shape[0] and narrow.shape[1:] == (200, 3)
    assert wide.dtype == np.uint8 and not any(strip.shape[0] % 2 for strip in (wide, narrow))
    assert rows_of(narrow, GREEN).max() < rows_of(narrow, RED).min()
    for colour in (GREEN, RED):
        assert len(columns_of(narrow, colour)) == len(columns_of(wide, colour))


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
