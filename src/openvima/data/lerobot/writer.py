"""Writes a LeRobot data set, episode by episode."""

import contextlib
import json
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from openvima.data.lerobot import layout
from openvima.data.lerobot.dense import DenseTrajectory
from openvima.data.lerobot.features import FrameLayout
from openvima.data.lerobot.statistics import PixelCounts, Statistics, value_statistics
from openvima.data.lerobot.tables import NumberedTable, write_tasks
from openvima.data.lerobot.videos import NumberedVideo, PixelFormat
from openvima.data.records import Demonstration

ROBOT_TYPE = "ur5"


class LerobotWriter:
    """Writes a data set into an empty folder; a context manager.

    The folder is a data set when the block has ended well. One episode is in memory at a time.

    Args:
        folder: The folder.
        frames: What a frame holds.
        fps: Frames a second.
        pixels: Pixel format of the videos.
        data_file_mb: Limit of the Parquet files.
        video_file_mb: Limit of the videos.
    """

    def __init__(
        self,
        folder: Path,
        frames: FrameLayout,
        *,
        fps: int,
        pixels: PixelFormat,
        data_file_mb: int = layout.DATA_FILE_MB,
        video_file_mb: int = layout.VIDEO_FILE_MB,
    ) -> None:
        self._folder, self._frames, self._fps, self._pixels = folder, frames, fps, pixels
        self._limits = {"data_files_size_in_mb": data_file_mb, "video_files_size_in_mb": video_file_mb}
        self._schema = _schema(frames)
        self._tasks: dict[str, int] = {}
        self._num_episodes = self._num_frames = 0
        self._row_schema: pa.Schema | None = None  # of the list of episodes; its first row gives it
        self._row_bytes = 0
        self._pixel_counts = {key: PixelCounts() for key in frames.video_keys}
        self._closing = contextlib.ExitStack()
        data_bytes, video_bytes = (limit * layout.BYTES_PER_MB for limit in self._limits.values())
        self._data, self._episodes = (
            self._closing.enter_context(NumberedTable(folder, pattern, limit_bytes=data_bytes))
            for pattern in (layout.DATA_PATH, layout.EPISODES_PATH)
        )
        self._videos = {
            key: self._closing.enter_context(
                NumberedVideo(folder, key, fps=fps, pixels=pixels, limit_bytes=video_bytes)
            )
            for key in frames.video_keys
        }

    def write(self, demo: Demonstration | DenseTrajectory) -> None:
        """Append an episode.

        Args:
            demo: At least one step, with no more prompt images than the layout has.
        """
        values = {**self._frames.values(demo), **self._counters(demo)}  # type: ignore[arg-type]  # of the layout
        number = self._data.write(_table(values, self._schema))
        places, statistics = self._write_pictures(demo)
        statistics |= {name: value_statistics(column) for name, column in values.items()}
        row = {
            "episode_index": self._num_episodes,
            "tasks": [demo.prompt.text],
            "length": demo.num_steps,
            "data/chunk_index": number.chunk,
            "data/file_index": number.file,
            "dataset_from_index": self._num_frames,
            "dataset_to_index": self._num_frames + demo.num_steps,
            **places,
            **{
                f"stats/{name}/{kind}": value.tolist()
                for name, entry in statistics.items()
                for kind, value in entry.items()
            },
        }
        self._write_episode(row)
        self._num_episodes += 1
        self._num_frames += demo.num_steps

    def __enter__(self) -> "LerobotWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closing.__exit__(kind, error, trace)
        if kind is None:
            self._write_metadata()

    def _counters(self, demo: Demonstration | DenseTrajectory) -> dict[str, np.ndarray]:
        steps = np.arange(demo.num_steps)
        task_index = self._tasks.setdefault(demo.prompt.text, len(self._tasks))
        return {
            "timestamp": (steps / self._fps).astype(np.float32),
            "frame_index": steps,
            "episode_index": np.full_like(steps, self._num_episodes),
            "index": steps + self._num_frames,
            "task_index": np.full_like(steps, task_index),
        }

    def _write_pictures(
        self, demo: Demonstration | DenseTrajectory
    ) -> tuple[dict[str, Any], dict[str, Statistics]]:
        places: dict[str, Any] = {}  # Any: whole numbers and seconds
        statistics = {}
        for key, pictures in self._frames.pictures(demo).items():  # type: ignore[arg-type]  # as above
            place = self._videos[key].write(pictures, num_frames=demo.num_steps)
            counts = PixelCounts()
            counts.add(pictures, num_frames=demo.num_steps)
            self._pixel_counts[key].merge(counts)
            statistics[key] = counts.statistics()
            places |= {
                f"videos/{key}/chunk_index": place.number.chunk,
                f"videos/{key}/file_index": place.number.file,
                f"videos/{key}/from_timestamp": place.first_frame / self._fps,
                f"videos/{key}/to_timestamp": (place.first_frame + demo.num_steps) / self._fps,
            }
        return places, statistics

    def _write_episode(self, row: dict[str, Any]) -> None:  # Any: one column, one type
        """Append a row to the list of episodes, which says itself in which file it is."""
        number = self._episodes.place(self._row_bytes)
        own_place = {"meta/episodes/chunk_index": number.chunk, "meta/episodes/file_index": number.file}
        table = pa.Table.from_pylist([row | own_place], schema=self._row_schema)
        self._episodes.write(table, number)
        self._row_schema, self._row_bytes = table.schema, max(self._row_bytes, table.nbytes)

    def _write_metadata(self) -> None:
        info = {
            "codebase_version": layout.CODEBASE_VERSION,
            "robot_type": ROBOT_TYPE,
            "total_episodes": self._num_episodes,
            "total_frames": self._num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": layout.FILES_PER_CHUNK,
            **self._limits,
            "fps": self._fps,
            "splits": {"train": f"0:{self._num_episodes}"},
            "data_path": layout.DATA_PATH,
            "video_path": layout.VIDEO_PATH,
            "features": self._frames.features(fps=self._fps, pixels=self._pixels),
        }
        statistics = {key: counts.statistics() for key, counts in self._pixel_counts.items()}
        statistics |= {name: self._overall(name) for name in self._schema.names}
        plain = {
            name: {kind: value.tolist() for kind, value in entry.items()}
            for name, entry in statistics.items()
        }
        write_json(self._folder / layout.INFO_PATH, info)
        write_json(self._folder / layout.STATISTICS_PATH, plain)
        write_tasks(self._folder / layout.TASKS_PATH, list(self._tasks))

    def _overall(self, name: str) -> Statistics:
        """Statistics of a column over all frames, read back from the files: a component at a time."""
        paths = sorted((self._folder / "data").rglob("*.parquet"))
        column = np.concatenate([_read(path, name) for path in paths])
        parts = [value_statistics(component) for component in column.T]
        joined = {kind: np.concatenate([part[kind] for part in parts]) for kind in parts[0]}
        return {**joined, "count": parts[0]["count"]}


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
