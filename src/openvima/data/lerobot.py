"""Export of demonstrations to a LeRobotDataset v3.0: Parquet, MP4 and JSON that LeRobot opens as its own.

First its files: tables, videos and statistics, and when a new file begins; then the export.

Source: the format's documentation (huggingface.co/docs/lerobot/lerobot-dataset-v3) and lerobot 0.4.4.
"""

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from openvima import __version__
from openvima.atomic_io import atomic_folder, folder_lock
from openvima.data.lerobot_frames import (
    FrameLayout,
    Trajectory,
    dense_settings,
    dense_trajectory,
    frame_layout,
    step_trajectory,
)
from openvima.data.reader import Dataset
from openvima.data.schema import IMAGE_SHAPE
from openvima.data.subsets import check_out
from openvima.errors import ConfigError
from openvima.input_files import settle
from openvima.multiprocess import Report
from openvima.render import channels_last
from openvima.scene.action import CONTROL_HZ, END_EFFECTOR, PRIMITIVES
from openvima.video.encoder import VideoWriter, import_av

CODEBASE_VERSION = "v3.0"
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


def numbered_path(folder: Path, pattern: str, number: int, **names: str) -> Path:
    """Return the path of a file by its number in the data set; its folder is made.

    Args:
        folder: The data set.
        pattern: One of the patterns above; all files are in the first chunk.
        number: From 0.
        **names: What else the pattern asks for.
    """
    path = folder / pattern.format(chunk_index=0, file_index=number, **names)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _place(prefix: str, number: int) -> dict[str, int]:
    """Return the entries of an episode that say in which file it is."""
    return {f"{prefix}/chunk_index": 0, f"{prefix}/file_index": number}


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


_COMPRESSION = "snappy"  # as LeRobot writes


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
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


PixelFormat = Literal["yuv444p", "yuv420p"]
PIXEL_FORMATS: tuple[PixelFormat, ...] = get_args(PixelFormat)

# Each episode begins with a frame that needs no other, and no frames are out of order, so reading one never
# decodes those before.
_ENCODING = {"preset": "superfast", "tune": "zerolatency", "forced-idr": "1"}
_QUALITY = {"yuv444p": {"qp": "0"}, "yuv420p": {"crf": "12"}}


ROBOT_TYPE = "ur5"


class LerobotWriter:
    """Writes a data set into an empty folder, which is one after `finish`.

    Numbers of up to `EPISODES_PER_FILE` episodes are in memory, and the pictures of one.

    Args:
        folder: The folder.
        closing: Closes the videos, also should something fail.
        frames: What a frame holds.
        fps: Frames a second.
        pixels: Pixel format of the videos.
    """

    def __init__(
        self,
        folder: Path,
        closing: contextlib.ExitStack,
        frames: FrameLayout,
        *,
        fps: int,
        pixels: PixelFormat,
    ) -> None:
        self._folder, self._frames, self._fps, self._pixels = folder, frames, fps, pixels
        self._schema = _schema(frames)
        self._tasks: dict[str, int] = {}
        self._num_episodes = self._num_frames = 0
        self._first_frame = 0  # of the present files
        self._row_schema: pa.Schema | None = None  # of the list of episodes; its first row gives it
        self._tables: list[pa.Table] = []  # frames of each episode of the present files
        self._rows: list[dict[str, Any]] = []  # and its entry in the list of episodes
        self._pixel_counts = {key: np.zeros((3, 256), np.int64) for key in frames.video_keys}
        self._closing = closing
        self._videos: dict[str, VideoWriter] = {}

    def write(self, demo: Trajectory) -> None:
        """Append an episode.

        Args:
            demo: At least one step, with no more prompt images than the layout has.
        """
        number = self._num_episodes // EPISODES_PER_FILE
        if not self._rows:
            self._begin_files(number)
        values = {**self._frames.values(demo), **self._counters(demo)}
        self._tables.append(_table(values, self._schema))
        statistics = {**self._write_pictures(demo), **{k: value_statistics(v) for k, v in values.items()}}
        start, end = self._num_frames, self._num_frames + demo.num_steps
        row = {
            "episode_index": self._num_episodes,
            "tasks": [demo.prompt.text],
            "length": demo.num_steps,
            **_place("data", number),
            "dataset_from_index": start,
            "dataset_to_index": end,
            **_place("meta/episodes", number),
        }
        for key in self._frames.video_keys:
            row |= _place(f"videos/{key}", number)
            row[f"videos/{key}/from_timestamp"] = (start - self._first_frame) / self._fps
            row[f"videos/{key}/to_timestamp"] = (end - self._first_frame) / self._fps
        for name, entry in statistics.items():
            row |= {f"stats/{name}/{kind}": value.tolist() for kind, value in entry.items()}
        self._rows.append(row)
        self._num_episodes += 1
        self._num_frames = end
        if len(self._rows) == EPISODES_PER_FILE:
            self._finish_files(number)

    def finish(self) -> None:
        """Write what is left, and the metadata."""
        if self._rows:
            self._finish_files(self._num_episodes // EPISODES_PER_FILE)
        self._write_metadata()

    def _counters(self, demo: Trajectory) -> dict[str, np.ndarray]:
        steps = np.arange(demo.num_steps)
        task_index = self._tasks.setdefault(demo.prompt.text, len(self._tasks))
        return {
            "timestamp": (steps / self._fps).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full_like(steps, self._num_episodes),
            "index": steps + self._num_frames,
            "task_index": np.full_like(steps, task_index),
        }

    def _write_pictures(self, demo: Trajectory) -> dict[str, Statistics]:
        statistics = {}
        views = {view: images[: demo.num_steps] for view, images in demo.rgb.items()}
        for key, pictures in self._frames.pictures(views, demo.prompt).items():
            for index, picture in enumerate(pictures):
                repeat = demo.num_steps // len(pictures)
                self._videos[key].write(channels_last(picture), repeat=repeat, is_key=index == 0)
            counts = count_pixels(pictures, demo.num_steps)
            self._pixel_counts[key] += counts
            statistics[key] = pixel_statistics(counts, demo.num_steps)
        return statistics

    def _begin_files(self, number: int) -> None:
        self._first_frame = self._num_frames
        height, width = IMAGE_SHAPE
        for key in self._frames.video_keys:
            video = VideoWriter(
                numbered_path(self._folder, VIDEO_PATH, number, video_key=key),
                width,
                height,
                frames_per_second=self._fps,
                pixels=self._pixels,
                options={**_ENCODING, **_QUALITY[self._pixels]},
            )
            self._videos[key] = self._closing.enter_context(video)

    def _finish_files(self, number: int) -> None:
        """Close the videos, and write the tables of their episodes."""
        self._closing.close()
        rows = pa.Table.from_pylist(self._rows, schema=self._row_schema)
        self._row_schema = rows.schema
        for pattern, table in ((DATA_PATH, pa.concat_tables(self._tables)), (EPISODES_PATH, rows)):
            path = numbered_path(self._folder, pattern, number)
            pq.write_table(table, path, compression=_COMPRESSION)
        self._tables, self._rows = [], []

    def _write_metadata(self) -> None:
        info = {
            "codebase_version": CODEBASE_VERSION,
            "robot_type": ROBOT_TYPE,
            "total_episodes": self._num_episodes,
            "total_frames": self._num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{self._num_episodes}"},
            "data_path": DATA_PATH,
            "video_path": VIDEO_PATH,
            "features": self._frames.features(fps=self._fps, pixels=self._pixels),
        }
        counted = self._pixel_counts.items()
        statistics = {key: pixel_statistics(counts, self._num_frames) for key, counts in counted}
        statistics |= {name: self._overall(name) for name in self._schema.names}
        plain = {
            name: {kind: value.tolist() for kind, value in entry.items()}
            for name, entry in statistics.items()
        }
        write_json(self._folder / INFO_PATH, info)
        write_json(self._folder / STATISTICS_PATH, plain)
        write_tasks(self._folder / TASKS_PATH, list(self._tasks))

    def _overall(self, name: str) -> Statistics:
        """Statistics of a column over all frames, read back from the files."""
        paths = sorted((self._folder / "data").rglob("*.parquet"))
        return value_statistics(np.concatenate([_read(path, name) for path in paths]))


def write_json(path: Path, content: object) -> None:
    """Write a JSON file as LeRobot does."""
    path.write_text(json.dumps(content, indent=4, ensure_ascii=False), encoding="utf-8")


def _schema(frames: FrameLayout) -> pa.Schema:
    def field(name: str, dtype: str, length: int) -> pa.Field:
        number = pa.type_for_alias(dtype)
        return pa.field(name, number if length == 1 else pa.list_(number, length))

    features = frames.value_features()
    return pa.schema([field(name, f["dtype"], f["shape"][0]) for name, f in features.items()])


def _table(values: dict[str, np.ndarray], schema: pa.Schema) -> pa.Table:
    def column(field: pa.Field) -> pa.Array:
        flat = pa.array(values[field.name].reshape(-1))
        is_list = pa.types.is_fixed_size_list(field.type)
        return pa.FixedSizeListArray.from_arrays(flat, type=field.type) if is_list else flat

    return pa.Table.from_arrays([column(field) for field in schema], schema=schema)


def _read(path: Path, name: str) -> np.ndarray:
    """Read a column of numbers, shape (N, D)."""
    column = pq.ParquetFile(path).read(columns=[name], use_threads=False).column(0).combine_chunks()
    num_rows = len(column)
    if pa.types.is_fixed_size_list(column.type):
        column = column.flatten()
    return column.to_numpy(zero_copy_only=False).reshape(num_rows, -1)


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
        if self.pixels not in PIXEL_FORMATS:
            raise ConfigError(f"pixels is {self.pixels!r}; allowed are {', '.join(PIXEL_FORMATS)}.")


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
    check_out(config.out, [config.data], force=config.force, is_own=lambda out: (out / INFO_PATH).is_file())
    settings = dense_settings(dataset)
    fps = CONTROL_HZ if settings else 1  # a whole number of float32 seconds, by which LeRobot finds frames
    layout = find_layout(dataset, END_EFFECTOR if settings else PRIMITIVES)
    with folder_lock(config.out), atomic_folder(config.out) as folder, contextlib.ExitStack() as closing:
        writer = LerobotWriter(folder, closing, layout, fps=fps, pixels=config.pixels)
        for number, demo in enumerate(dataset, 1):
            if settings:
                writer.write(dense_trajectory(demo, settings[demo.task, demo.level]))
            else:
                writer.write(step_trajectory(demo, has_joints=layout.has_joints))
            if report:
                report(number, len(dataset), demo.task)
        writer.finish()
        _write_source(folder, dataset, config, fps)
    return config.out


def find_layout(dataset: Dataset, control: str) -> FrameLayout:
    """Find what the frames of all episodes have in common, without reading images.

    Args:
        dataset: The demonstrations.
        control: "primitives" or "end_effector".
    """
    num_images, has_joints = 0, True
    for name in dataset.shard_names():
        table = dataset.shard(name).table(["prompt_images", "joint_paths", "steps"])
        images, paths, steps = (column.combine_chunks() for column in table.columns)
        num_images = max(num_images, *images.value_lengths().to_pylist())
        has_joints = has_joints and paths.value_lengths().equals(steps)
    return frame_layout(control, num_images, has_joints)


def _write_source(folder: Path, dataset: Dataset, config: LerobotConfig, fps: int) -> None:
    """Write where the episodes came from, which the format has no place for."""
    manifest = dataset.manifest
    source = {key: manifest[key] for key in ("command", "config", "content_hash", "licence", "versions")}
    versions = {"openvima": __version__, "av": import_av().__version__, "pyarrow": pa.__version__}
    settings = {"tasks": config.tasks, "fps": fps, "pixels": config.pixels}
    write_json(
        folder / SOURCE_PATH,
        {
            "command": "openvima data export-lerobot",
            "config": settings,
            "versions": versions,
            "source": source,
        },
    )
    index = dataset.index.select(["task", "level", "seed", "content_hash"])
    numbers = pa.array(range(index.num_rows), pa.int64())
    index = index.add_column(0, "episode_index", numbers)
    pq.write_table(index, folder / SOURCE_EPISODES_PATH, compression="snappy")
