"""The files of an export: features, tables, statistics, videos."""

from pathlib import Path

import av
import numpy as np
import pytest

from openvima.data import Demonstration
from openvima.data.lerobot import (
    QUANTILES,
    count_pixels,
    pixel_statistics,
    value_statistics,
)
from openvima.data.lerobot_frames import FrameLayout, step_trajectory
from openvima.errors import ActionError
from openvima.scene import END_EFFECTORS, Action
from openvima.scene.action import ToolCommand
from openvima.video.encoder import open_video


@pytest.mark.parametrize("has_joints", [True, False])
def test_an_observation_is_encoded_as_the_frame_of_the_export(
    demos: list[Demonstration], has_joints: bool
) -> None:
    layout = FrameLayout(3, has_joints)
    for demo in demos:
        values = layout.values(step_trajectory(demo, has_joints=has_joints))
        pictures = layout.pictures(demo.rgb, demo.prompt)
        for step in range(demo.num_steps):
            observation = {
                "rgb": {view: images[step] for view, images in demo.rgb.items()},
                "joints": demo.joint_paths[step][0],
                "ee": END_EFFECTORS.index(demo.end_effector),
            }
            frame = layout.frame(observation, demo.prompt)
            np.testing.assert_array_equal(frame["agent_pos"], values["observation.state"][step])
            assert [f"observation.images.{name}" for name in frame["pixels"]] == list(layout.video_keys)
            for key, images in pictures.items():
                shown = frame["pixels"][key.rpartition(".")[2]]
                np.testing.assert_array_equal(np.moveaxis(shown, -1, 0), images[min(step, len(images) - 1)])
            row = values["action"][step]
            for key, array in demo.actions[step].to_arrays().items():
                np.testing.assert_allclose(layout.action(row)[key], array, atol=1e-6)


def test_a_row_beyond_the_bounds_is_brought_back_and_one_that_is_none_is_refused() -> None:
    row = np.array([0.9, -0.7, 0, 0, 3, 4, 0.5, 0.1, 0, 0, 0, 0], np.float32)
    layout = FrameLayout(0, True)
    action = Action.from_arrays(layout.action(row))
    assert action.pose0_position == (0.75, -0.5)
    assert action.pose0_rotation == pytest.approx((0, 0, 0.6, 0.8))
    for bad in (np.nan, np.inf):
        row[0] = bad
        with pytest.raises(ActionError, match="must be finite"):
            Action.from_arrays(layout.action(row))
    with pytest.raises(ActionError, match=r"shape \(11,\)"):
        layout.action(row[:11])
    with pytest.raises(ActionError, match="dtype int64; it must be 12 floating-point numbers"):
        layout.action(np.zeros(12, np.int64))


def test_a_row_of_commands_is_one_for_the_environment() -> None:
    layout = FrameLayout(0, True, "end_effector")
    assert layout.action_names == ("dx", "dy", "dz", "dyaw", "tool")
    row = np.array([0.5, 0, 0, 0, 0.7], np.float64)
    assert ToolCommand.from_array(layout.action(row)).dx == pytest.approx(0.05)
    for bad in (row[:4], row.astype(int), np.zeros((1, 5))):
        with pytest.raises(ActionError, match="5 floating-point numbers: dx, dy, dz, dyaw, tool"):
            layout.action(bad)
    assert FrameLayout(0, False).state_names == ("end_effector",)


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


def pictures(number: int, seed: int = 0) -> np.ndarray:
    """Pictures of coloured blocks with noise on them, shape (number, 3, 128, 256), uint8."""
    rng = np.random.default_rng(seed)
    blocks = rng.integers(0, 240, (number, 3, 16, 32), dtype=np.uint8).repeat(8, axis=2).repeat(8, axis=3)
    return blocks + rng.integers(0, 16, blocks.shape, dtype=np.uint8)


def write(path: Path, episodes: list[np.ndarray], *, fps: int) -> Path:
    height, width = episodes[0].shape[2:]
    with open_video(path, width, height, frames_per_second=fps, pixels="yuv444p") as write_frame:
        for episode in episodes:
            for step, picture in enumerate(episode):
                write_frame(np.moveaxis(picture, 0, -1), is_key=step == 0)
    return path


@pytest.mark.parametrize(("fps", "lengths"), [(1, [1]), (16, [2, 1, 4])])
def test_frames_lie_at_exact_times_and_an_episode_begins_with_a_key_frame(
    tmp_path: Path, fps: int, lengths: list[int]
) -> None:
    episodes = [pictures(n, seed) for seed, n in enumerate(lengths)]
    path = write(tmp_path / "film.mp4", episodes, fps=fps)
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
