"""Export of demonstrations to a LeRobotDataset v3.0: Parquet, MP4 and JSON that LeRobot opens as its own.

First its files: tables, videos and statistics, and when a new file begins; then the export.

Source: the format's documentation (huggingface.co/docs/lerobot/lerobot-dataset-v3) and lerobot 0.4.4.
"""

import contextlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from openvima import __version__
from openvima.catalog.packs import recorded_assets
from openvima.data.encoding import list_rows
from openvima.data.lerobot_frames import (
    FrameLayout,
    Trajectory,
    dense_trajectory,
    frame_layout,
    step_trajectory,
)
from openvima.data.reader import Dataset
from openvima.data.schema import IMAGE_SHAPE
from openvima.data.subsets import new_folder
from openvima.errors import ConfigError, DatasetError
from openvima.input_files import settle
from openvima.multiprocess import Report
from openvima.render import channels_last
from openvima.scene.action import END_EFFECTOR
from openvima.video.encoder import WriteFrame, import_av, open_video

CODEBASE_VERSION = "v3.0"
ROBOT_TYPE = "ur5"
EPISODES_PER_FILE = 1000  # of tables and videos

INFO_PATH = "meta/info.json"
STATISTICS_PATH = "meta/stats.json"
TASKS_PATH = "meta/tasks.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

# Not part of the format: where the episodes came from.
SOURCE_PATH = "meta/openvima.json"
SOURCE_EPISODES_PATH = "meta/openvima.parquet"

PixelFormat = Literal["yuv444p", "yuv420p"]
# Each episode begins with a frame that needs no other, and no frames are out of order, so reading one never
# decodes those before.
_ENCODING = {"preset": "superfast", "tune": "zerolatency", "forced-idr": "1"}
_QUALITY = {"yuv444p": {"qp": "0"}, "yuv420p": {"crf": "12"}}
_COMPRESSION = "snappy"  # as LeRobot writes

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_BRIGHTNESS = np.arange(256) / 255

Statistics = dict[str, np.ndarray]


def value_statistics(values: np.ndarray) -> Statistics:
    """Return the statistics of numbers.

    Args:
        values: Shape (N, D) or (N,), any dtype, N at least 1.

    Returns:
        "min" and "max" in the dtype of the values, "mean", "std" and the quantiles in float64, all of shape
        (D,), and "count", shape (1,).
    """
    columns = values.reshape(len(values), -1).T
    counted = [np.unique(column, return_counts=True) for column in columns]
    return _statistics(counted, len(values), (len(columns),))


def count_pixels(pictures: np.ndarray, num_frames: int) -> np.ndarray:
    """Count how often each brightness occurs in the pictures of an episode, by channel.

    Args:
        pictures: Shape (num_frames or 1, 3, height, width), uint8; one picture stands for all frames.
        num_frames: Frames of the episode.

    Returns:
        Shape (3, 256), int64.
    """
    channels = pictures.swapaxes(0, 1)
    counts = [np.bincount(channel.reshape(-1), minlength=256) for channel in channels]
    return np.stack(counts) * (num_frames // len(pictures))


def pixel_statistics(counts: np.ndarray, num_frames: int) -> Statistics:
    """Return the statistics of brightness from 0 to 1: shape (3, 1, 1), "count" is that of frames."""
    counted = [(_BRIGHTNESS[channel > 0], channel[channel > 0]) for channel in counts]
    return _statistics(counted, num_frames, (3, 1, 1))


def _statistics(
    columns: Sequence[tuple[np.ndarray, np.ndarray]], num_frames: int, shape: tuple[int, ...]
) -> Statistics:
    """Return the statistics of columns of numbers, each given by its different values and their counts."""
    parts = [_column_statistics(*column) for column in columns]
    joined = {name: np.array([part[name] for part in parts]).reshape(shape) for name in parts[0]}
    return {**joined, "count": np.array([num_frames])}


def _column_statistics(values: np.ndarray, counts: np.ndarray) -> dict[str, np.generic]:
    """Return the statistics of ascending values, of which each occurs so often."""
    numbers, total = values.astype(np.float64), counts.sum()
    mean = counts @ numbers / total
    ranks = np.ceil(np.array([*QUANTILES.values()]) * total - 1e-9)
    return {
        "min": values[0],
        "max": values[-1],
        "mean": mean,
        "std": np.sqrt(counts @ (numbers - mean) ** 2 / total),
        **dict(zip(QUANTILES, numbers[counts.cumsum().searchsorted(ranks)], strict=True)),
    }


class LerobotWriter:
    """Writes a data set into an empty folder, file by file; `finish` then makes it whole.

    The numbers of all frames are in memory, some 120 bytes each, and the pictures of one episode.

    Args:
        folder: The folder.
        layout: What a frame holds.
        pixels: Pixel format of the videos.
    """

    def __init__(self, folder: Path, layout: FrameLayout, pixels: PixelFormat) -> None:
        self._folder, self._layout, self._pixels = folder, layout, pixels
        self._tasks: dict[str, int] = {}
        self._values: list[dict[str, np.ndarray]] = []  # of each episode, by column
        self._num_frames = 0
        self._pixel_counts = {key: np.zeros((3, 256), np.int64) for key in layout.video_keys}

    def write_file(self, number: int, episodes: Iterable[Trajectory]) -> None:
        """Write the next episodes as one file of each kind: videos, frames, and the list of episodes.

        Args:
            number: From 0.
            episodes: Of at least one step, with no more prompt images than the layout has.
        """
        first_frame, fps, tables, rows = self._num_frames, self._layout.fps, [], []
        with contextlib.ExitStack() as closing:
            videos = {key: closing.enter_context(self._video(key, number)) for key in self._pixel_counts}
            for demo in episodes:
                values = {**self._layout.values(demo), **self._counters(demo)}
                statistics = self._write_pictures(demo, videos)
                statistics |= {name: value_statistics(column) for name, column in values.items()}
                start, end = self._num_frames, self._num_frames + demo.num_steps
                row = {
                    "episode_index": len(self._values),
                    "tasks": [demo.prompt.text],
                    "length": demo.num_steps,
                    **_place("data", number),
                    "dataset_from_index": start,
                    "dataset_to_index": end,
                    **_place("meta/episodes", number),
                }
                for key in videos:
                    row |= _place(f"videos/{key}", number)
                    row[f"videos/{key}/from_timestamp"] = (start - first_frame) / fps
                    row[f"videos/{key}/to_timestamp"] = (end - first_frame) / fps
                for name, entry in statistics.items():
                    row |= {f"stats/{name}/{kind}": value.tolist() for kind, value in entry.items()}
                rows.append(row)
                tables.append(pa.table({name: list_rows(column) for name, column in values.items()}))
                self._values.append(values)
                self._num_frames = end
        for pattern, table in (
            (DATA_PATH, pa.concat_tables(tables)),
            (EPISODES_PATH, pa.Table.from_pylist(rows)),
        ):
            pq.write_table(table, self._path(pattern, number), compression=_COMPRESSION)

    def finish(self) -> None:
        """Write the metadata."""
        columns = {
            name: np.concatenate([values[name] for values in self._values]) for name in self._values[0]
        }
        info = {
            "codebase_version": CODEBASE_VERSION,
            "robot_type": ROBOT_TYPE,
            "total_episodes": len(self._values),
            "total_frames": self._num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._layout.fps,
            "splits": {"train": f"0:{len(self._values)}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "features": self._features(columns),
        }
        counted = self._pixel_counts.items()
        statistics = {key: pixel_statistics(counts, self._num_frames) for key, counts in counted}
        statistics |= {name: value_statistics(column) for name, column in columns.items()}
        write_json(self._folder / INFO_PATH, info)
        write_json(self._folder / STATISTICS_PATH, statistics)
        _write_tasks(self._folder / TASKS_PATH, list(self._tasks))

    def _features(self, columns: Mapping[str, np.ndarray]) -> dict[str, dict[str, Any]]:
        """Return what `info.json` says of the videos and of the columns of the tables."""
        height, width = IMAGE_SHAPE
        video = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": self._pixels,
                "video.is_depth_map": False,
                "video.fps": self._layout.fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
        names = {"observation.state": self._layout.state_names, "action": self._layout.action_names}
        numbers = {
            name: {"dtype": str(column.dtype), "shape": column.shape[1:] or [1], "names": names.get(name)}
            for name, column in columns.items()
        }
        return {**dict.fromkeys(self._layout.video_keys, video), **numbers}

    def _counters(self, demo: Trajectory) -> dict[str, np.ndarray]:
        """Return the columns that every LeRobot data set has, after its own."""
        steps = np.arange(demo.num_steps)
        task_index = self._tasks.setdefault(demo.prompt.text, len(self._tasks))
        return {
            "timestamp": (steps / self._layout.fps).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full_like(steps, len(self._values)),
            "index": steps + self._num_frames,
            "task_index": np.full_like(steps, task_index),
        }

    def _video(self, key: str, number: int) -> contextlib.AbstractContextManager[WriteFrame]:
        height, width = IMAGE_SHAPE
        return open_video(
            self._path(VIDEO_PATH, number, video_key=key),
            width,
            height,
            frames_per_second=self._layout.fps,
            pixels=self._pixels,
            options={**_ENCODING, **_QUALITY[self._pixels]},
        )

    def _write_pictures(self, demo: Trajectory, videos: Mapping[str, WriteFrame]) -> dict[str, Statistics]:
        statistics = {}
        views = {view: images[: demo.num_steps] for view, images in demo.rgb.items()}
        for key, pictures in self._layout.pictures(views, demo.prompt).items():
            for index, picture in enumerate(pictures):
                repeat = demo.num_steps // len(pictures)
                videos[key](channels_last(picture), repeat=repeat, is_key=index == 0)
            counts = count_pixels(pictures, demo.num_steps)
            self._pixel_counts[key] += counts
            statistics[key] = pixel_statistics(counts, demo.num_steps)
        return statistics

    def _path(self, pattern: str, number: int, **names: str) -> Path:
        """Return the path of a file by its number; its folder is made. All are in the first chunk."""
        path = self._folder / pattern.format(chunk_index=0, file_index=number, **names)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def _place(prefix: str, number: int) -> dict[str, int]:
    """Return the entries of an episode that say in which file it is."""
    return {f"{prefix}/chunk_index": 0, f"{prefix}/file_index": number}


def _write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the list of prompts; LeRobot reads it with pandas and expects the texts as its index."""
    columns = {"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())}
    kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}
        for name, kind, numpy_type in kinds
    ]
    notes = {"index_columns": ["task"], "column_indexes": [], "columns": described}
    table = pa.table(columns).replace_schema_metadata({"pandas": json.dumps(notes)})
    pq.write_table(table, path, compression=_COMPRESSION)


def write_json(path: Path, content: object) -> None:
    """Write a JSON file as LeRobot does; arrays become lists."""
    text = json.dumps(content, indent=4, ensure_ascii=False, default=np.ndarray.tolist)
    path.write_text(text, encoding="utf-8")


@dataclass(frozen=True, slots=True)
class LerobotConfig:
    """What to export, and where to.

    Args:
        data: Folder of demonstrations.
        out: Folder of the export.
        tasks: Keep the episodes of these tasks only; None keeps all.
        pixels: "yuv444p" keeps colours within 2 of 255 levels; "yuv420p" is what browsers and graphics cards
            play, at half the resolution of colours.
        force: Replace the export that is at `out`.

    Raises:
        ConfigError: A value is not allowed.
    """

    data: Path
    out: Path
    tasks: tuple[str, ...] | None = None
    pixels: PixelFormat = "yuv444p"
    force: bool = False

    def __post_init__(self) -> None:
        settle(self, paths=("data", "out"), names=("tasks",))
        if self.pixels not in _QUALITY:
            raise ConfigError(f"pixels is {self.pixels!r}; allowed are {', '.join(_QUALITY)}.")


def export_lerobot(config: LerobotConfig, report: Report | None = None) -> Path:
    """Export demonstrations to the LeRobotDataset v3.0 format.

    The folder appears whole, or not at all. The same demonstrations, settings and versions of PyAV and
    pyarrow give the same bytes.

    Args:
        config: What and where to.
        report: Called as `report(episodes done, episodes in all, task)`.

    Returns:
        The folder.

    Raises:
        DatasetError: There are no such demonstrations, or the folder has content and `force` is not set.
        DatasetError: A shard is damaged.
        MissingExtraError: PyAV is not installed.
    """
    import_av()  # before the work begins
    dataset = Dataset(config.data, tasks=config.tasks)
    layout = find_layout(dataset)

    def trajectories(first: int) -> Iterator[Trajectory]:
        for index in range(first, min(first + EPISODES_PER_FILE, len(dataset))):
            demo = dataset[index]
            if layout.control == END_EFFECTOR:
                info = dataset.shard(dataset.locate(index)[0]).info
                yield dense_trajectory(demo, replace(info.env_config, assets=recorded_assets(info.assets)))
            else:
                yield step_trajectory(demo, has_joints=layout.has_joints)
            if report:
                report(index + 1, len(dataset), demo.task)

    with new_folder(
        config.out, [config.data], force=config.force, is_own=lambda out: (out / INFO_PATH).is_file()
    ) as folder:
        writer = LerobotWriter(folder, layout, config.pixels)
        for number, first in enumerate(range(0, len(dataset), EPISODES_PER_FILE)):
            writer.write_file(number, trajectories(first))
        writer.finish()
        _write_source(folder, dataset, config, layout.fps)
    return config.out


def find_layout(dataset: Dataset) -> FrameLayout:
    """Find what the frames of all episodes have in common, without reading images.

    Raises:
        DatasetError: Some of the demonstrations are of low-level control, and others are not.
    """
    controls, num_images, has_joints = set(), 0, True
    for name in dataset.shard_names():
        shard = dataset.shard(name)
        controls.add(shard.info.control)
        table = shard.table(["prompt_images", "joint_paths", "steps"])
        images, paths, steps = (column.combine_chunks() for column in table.columns)
        num_images = max(num_images, *images.value_lengths().to_pylist())
        has_joints = has_joints and paths.value_lengths().equals(steps)
    if len(controls) > 1:
        mixed = ", ".join(sorted(controls))
        raise DatasetError(f"{dataset.path} mixes controls {mixed}; export each by itself.")
    return frame_layout(controls.pop(), num_images, has_joints)


def _write_source(folder: Path, dataset: Dataset, config: LerobotConfig, fps: int) -> None:
    """Write where the episodes came from, which the format has no place for."""
    kept = ("command", "config", "content_hash", "licence", "versions")
    source = {
        "command": "openvima data export-lerobot",
        "config": {"tasks": config.tasks, "fps": fps, "pixels": config.pixels},
        "versions": {"openvima": __version__, "av": import_av().__version__, "pyarrow": pa.__version__},
        "source": {key: dataset.manifest[key] for key in kept},
    }
    write_json(folder / SOURCE_PATH, source)
    index = dataset.index.select(["task", "level", "seed", "content_hash"])
    index = index.add_column(0, "episode_index", pa.array(range(index.num_rows), pa.int64()))
    pq.write_table(index, folder / SOURCE_EPISODES_PATH, compression=_COMPRESSION)
