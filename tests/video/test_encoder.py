"""Videos: sizes, colours, order, and what browsers need."""

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
import pytest

from openvima.errors import ShapeError
from openvima.video.encoder import VideoWriter


def plain(colour: tuple[int, int, int], height: int = 48, width: int = 64) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


def write_video(path: Path, frames: Sequence[np.ndarray]) -> Path:
    with VideoWriter(path, frames[0].shape[1], frames[0].shape[0]) as video:
        for frame in frames:
            video.write(frame)
    return path


def read(path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def test_frames_come_back_in_order_with_their_colours(tmp_path):
    colours = [(220, 30, 30), (30, 200, 40), (30, 40, 210)]
    path = write_video(tmp_path / "video.mp4", [plain(colour) for colour in colours for _ in range(5)])
    frames = read(path)
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


def test_equal_frames_give_equal_bytes(tmp_path):
    frames = [plain((i, 2 * i, 255 - i)) for i in range(40)]
    first, second = (write_video(tmp_path / name, frames).read_bytes() for name in ("a.mp4", "b.mp4"))
    assert first == second


def test_a_frame_can_be_repeated(tmp_path):
    with VideoWriter(tmp_path / "still.mp4", 64, 48) as video:
        video.write(plain((1, 2, 3)), repeat=7)
    assert len(read(tmp_path / "still.mp4")) == 7


def test_odd_sizes_are_refused_before_a_file_is_made(tmp_path):
    with pytest.raises(ShapeError, match="even"):
        write_video(tmp_path / "odd.mp4", [plain((0, 0, 0), height=47)])
    assert not list(tmp_path.iterdir())


def test_frames_of_another_size_are_refused(tmp_path):
    with pytest.raises(ShapeError, match="the video takes"):
        write_video(tmp_path / "video.mp4", [plain((0, 0, 0)), plain((0, 0, 0), width=66)])


def test_an_interrupted_video_leaves_the_earlier_one(tmp_path):
    path = write_video(tmp_path / "video.mp4", [plain((9, 9, 9))] * 3)
    whole = path.read_bytes()
    with pytest.raises(KeyboardInterrupt), VideoWriter(path, 64, 48) as video:
        video.write(plain((200, 9, 9)))
        raise KeyboardInterrupt
    assert path.read_bytes() == whole
    assert list(tmp_path.iterdir()) == [path]
