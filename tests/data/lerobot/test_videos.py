"""Films with numbers: exact times, frames that survive, and files within their limit."""

from pathlib import Path

import av
import numpy as np
import pytest

from openvima.data import lerobot_files
from openvima.data.lerobot_files import FileNumber, NumberedVideo, PixelFormat

LARGE = 10**9


def pictures(number: int, seed: int = 0) -> np.ndarray:
    """Pictures of coloured blocks with noise on them, shape (number, 3, 128, 256), uint8."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 240, (number, 3, 16, 32), dtype=np.uint8).repeat(8, axis=2).repeat(8, axis=3)
    return blocks + rng.integers(0, 16, blocks.shape, dtype=np.uint8)


def write(folder: Path, episodes: list[np.ndarray], *, fps: int = 1, pixels: PixelFormat = "yuv444p") -> Path:
    with NumberedVideo(folder, "eye", fps=fps, pixels=pixels, limit_bytes=LARGE) as video:
        for episode in episodes:
            video.write(episode, num_frames=len(episode))
    return folder / "videos/eye/chunk-000/file-000.mp4"


@pytest.mark.parametrize("fps", [1, 16])
@pytest.mark.parametrize("lengths", [[1], [2, 1, 4]])
def test_frames_lie_at_exact_times_and_an_episode_begins_with_a_key_frame(
    tmp_path: Path, fps: int, lengths: list[int]
) -> None:
    path = write(tmp_path, [pictures(n, seed) for seed, n in enumerate(lengths)], fps=fps)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = list(container.decode(stream))
        assert [frame.time for frame in frames] == [index / fps for index in range(sum(lengths))]
        assert stream.frames == len(frames)
        assert stream.duration is not None
        assert stream.time_base is not None
        assert stream.duration * stream.time_base * fps == len(frames)
        assert stream.average_rate == fps
    starts = np.cumsum([0, *lengths[:-1]])
    assert all(frames[start].key_frame for start in starts)


def test_colours_survive_within_two_levels(tmp_path: Path) -> None:
    shown = pictures(5)
    path = write(tmp_path, [shown])
    with av.open(str(path)) as container:
        read = np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
    assert np.abs(np.moveaxis(read, -1, 1).astype(int) - shown).max() <= 2


def test_what_browsers_play_has_half_the_resolution_of_colours(tmp_path: Path) -> None:
    path = write(tmp_path, [pictures(2)], pixels="yuv420p")
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.pix_fmt == "yuv420p"


def test_one_picture_is_shown_for_the_whole_episode(tmp_path: Path) -> None:
    with NumberedVideo(tmp_path, "eye", fps=1, pixels="yuv444p", limit_bytes=LARGE) as video:
        video.write(pictures(1), num_frames=4)
    with av.open(str(tmp_path / "videos/eye/chunk-000/file-000.mp4")) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 4
    assert all((frame == frames[0]).all() for frame in frames)


def test_files_stay_below_their_limit(tmp_path: Path) -> None:
    limit, places = 400_000, []
    with NumberedVideo(tmp_path, "eye", fps=1, pixels="yuv444p", limit_bytes=limit) as video:
        for seed in range(9):
            places.append(video.write(pictures(2, seed), num_frames=2))
    files = sorted(tmp_path.rglob("*.mp4"))
    assert len(files) > 2
    assert all(file.stat().st_size < limit for file in files)
    numbers = [number for number, _ in places]
    assert numbers == sorted(numbers, key=lambda n: n.file)
    for file_index, file in enumerate(files):
        firsts = [first for number, first in places if number == FileNumber(0, file_index)]
        with av.open(str(file)) as container:
            assert container.streams.video[0].frames == 2 * len(firsts)
        assert firsts == list(range(0, 2 * len(firsts), 2))


def test_a_file_is_closed_after_so_many_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lerobot_files, "MAX_FRAMES", 4)
    with NumberedVideo(tmp_path, "eye", fps=1, pixels="yuv444p", limit_bytes=LARGE) as video:
        places = [video.write(pictures(1), num_frames=3) for _ in range(3)]
    assert [(number.file, first) for number, first in places] == [(0, 0), (0, 3), (1, 0)]


def test_nothing_is_in_the_way_of_the_first_error(tmp_path: Path) -> None:
    with (
        pytest.raises(ZeroDivisionError),
        NumberedVideo(tmp_path, "eye", fps=1, pixels="yuv444p", limit_bytes=LARGE) as video,
    ):
        video.write(pictures(1), num_frames=1)
        raise ZeroDivisionError
