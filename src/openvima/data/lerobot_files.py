"""The files of a LeRobot data set: tables, videos and statistics, and when a new file begins.

Source: the format's documentation (huggingface.co/docs/lerobot/lerobot-dataset-v3) and lerobot 0.4.4.
"""

import contextlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from openvima.data.lerobot_frames import DenseTrajectory, FrameLayout
from openvima.data.records import Demonstration
from openvima.data.schema import IMAGE_SHAPE
from openvima.render import channels_last
from openvima.video.encoder import import_av, open_video

CODEBASE_VERSION = "v3.0"
FILES_PER_CHUNK = 1000
DATA_FILE_MB = 100
VIDEO_FILE_MB = 200
BYTES_PER_MB = 1024**2

INFO_PATH = "meta/info.json"
STATISTICS_PATH = "meta/stats.json"
TASKS_PATH = "meta/tasks.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

# Not part of the format: where the episodes came from.
SOURCE_PATH = "meta/openvima.json"
SOURCE_EPISODES_PATH = "meta/openvima.parquet"


@dataclass(frozen=True, slots=True)
class FileNumber:
    """The place of one of the numbered files, `chunk-000/file-000` and so on."""

    chunk: int = 0
    file: int = 0

    def next(self) -> "FileNumber":
        """Return the place of the file after this one."""
        if self.file + 1 == FILES_PER_CHUNK:
            return FileNumber(self.chunk + 1, 0)
        return FileNumber(self.chunk, self.file + 1)

    def path(self, folder: Path, pattern: str, **names: str) -> Path:
        """Return the file's path; its folder is made.

        Args:
            folder: The data set.
            pattern: One of the patterns above.
            **names: What else the pattern asks for.
        """
        path = folder / pattern.format(chunk_index=self.chunk, file_index=self.file, **names)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Statistics = dict[str, np.ndarray]


def value_statistics(values: np.ndarray) -> Statistics:
    """Return the statistics of numbers.

    Args:
        values: Shape (N, D) or (N,), any dtype, N at least 1.

    Returns:
        "min" and "max" in the dtype of the values, "mean", "std" and the quantiles in float64, all of shape
        (D,), and "count", shape (1,).
    """
    table = values.reshape(len(values), -1)
    ordered = np.sort(table, axis=0)
    ranks = {name: _rank(share, len(table)) for name, share in QUANTILES.items()}
    return {
        "min": ordered[0],
        "max": ordered[-1],
        "mean": table.mean(axis=0, dtype=np.float64),
        "std": table.std(axis=0, dtype=np.float64),
        "count": np.array([len(table)]),
        **{name: ordered[rank].astype(np.float64) for name, rank in ranks.items()},
    }


def count_pixels(pictures: np.ndarray, num_frames: int) -> np.ndarray:
    """Count how often each brightness occurs in the pictures of an episode, by channel.

    Args:
        pictures: Shape (num_frames or 1, 3, height, width), uint8; one picture stands for all frames.
        num_frames: Frames of the episode.

    Returns:
        Shape (3, 256), int64.
    """
    counts = np.zeros((3, 256), np.int64)
    if not pictures.any():  # most prompts have fewer images than the longest
        counts[:, 0] = num_frames * pictures[0, 0].size
        return counts
    for channel in range(3):
        counts[channel] = np.bincount(pictures[:, channel].reshape(-1), minlength=256)
    return counts * (num_frames // len(pictures))


def pixel_statistics(counts: np.ndarray, num_frames: int) -> Statistics:
    """Return the statistics of brightness from 0 to 1: shape (3, 1, 1), "count" is that of frames."""
    levels = np.arange(256) / 255
    num_pixels = counts[0].sum()
    mean = counts @ levels / num_pixels
    squares = counts @ levels**2 / num_pixels
    below = counts.cumsum(axis=1)
    found = {
        "min": levels[(counts > 0).argmax(axis=1)],
        "max": levels[255 - (counts[:, ::-1] > 0).argmax(axis=1)],
        "mean": mean,
        "std": np.sqrt(np.maximum(squares - mean**2, 0)),
        "count": np.array([num_frames]),
        **{
            name: levels[(below > _rank(share, num_pixels)).argmax(axis=1)]
            for name, share in QUANTILES.items()
        },
    }
    return {name: row if name == "count" else row.reshape(3, 1, 1) for name, row in found.items()}


def _rank(share: float, count: int) -> int:
    """Place of a quantile among `count` sorted values, from 0."""
    return max(int(np.ceil(share * count - 1e-9)) - 1, 0)


_COMPRESSION = "snappy"  # as LeRobot writes
_FOOTER_BYTES = 400  # what a file's end holds for each column of a row group, generously

_MAX_PIECES = 16  # a row of 300 columns takes a megabyte as a table of its own, 20 kB among others


class NumberedTable:
    """A table over numbered Parquet files, each smaller than a limit; a context manager.

    Rows of one call to `write` stay together. LeRobot gives each of them a row group of its own; for episodes
    of a few frames that would make files of little but row groups, so here several share one.

    Args:
        folder: The data set.
        pattern: Where the files lie.
        limit_bytes: A file is closed before it becomes as large.
        group_bytes: Size of a row group before compression.
    """

    def __init__(self, folder: Path, pattern: str, *, limit_bytes: int, group_bytes: int = 2**22) -> None:
        self._folder, self._pattern = folder, pattern
        self._limit_bytes, self._group_bytes = limit_bytes, group_bytes
        self._number: FileNumber | None = None
        self._writer: pq.ParquetWriter | None = None
        self._file: pa.NativeFile | None = None
        self._waiting: list[pa.Table] = []
        self._waiting_bytes = self._footer_bytes = 0

    def place(self, num_bytes: int) -> FileNumber:
        """Return the number of the file that takes the next rows, if they have `num_bytes`."""
        if self._number is None:
            return FileNumber()
        written = (self._file.tell() if self._file else 0) + self._footer_bytes
        is_full = written + self._waiting_bytes + num_bytes >= self._limit_bytes
        return self._number.next() if is_full else self._number

    def write(self, rows: pa.Table, number: FileNumber | None = None) -> FileNumber:
        """Append rows.

        Args:
            rows: Always of the same schema.
            number: The file, as `place` gave it; None asks for it.

        Returns:
            The number of the file that they are in.
        """
        number = number or self.place(rows.nbytes)
        if number != self._number:
            self.close()
            self._number = number
        if not self._waiting:
            self._footer_bytes += _FOOTER_BYTES * rows.num_columns
        self._waiting.append(rows)
        self._waiting_bytes += rows.nbytes
        if self._waiting_bytes >= self._group_bytes:
            self._flush()
        elif len(self._waiting) >= _MAX_PIECES:
            self._waiting = [pa.concat_tables(self._waiting).combine_chunks()]
        return number

    def close(self) -> None:
        """Finish the present file."""
        self._flush()
        if self._writer and self._file:
            self._writer.close()
            self._file.close()
            self._writer = self._file = None
            self._footer_bytes = 0

    def __enter__(self) -> "NumberedTable":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()

    def _flush(self) -> None:
        if not self._waiting or self._number is None:
            return
        table = pa.concat_tables(self._waiting)
        if self._writer is None:
            path = self._number.path(self._folder, self._pattern)
            self._file = pa.OSFile(str(path), "wb")
            self._writer = pq.ParquetWriter(self._file, table.schema, compression=_COMPRESSION)
        self._writer.write_table(table, row_group_size=len(table))
        self._waiting, self._waiting_bytes = [], 0


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Write the list of prompts; LeRobot reads it with pandas and expects the texts as its index."""
    columns = {"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())}
    table = pa.table(columns)
    notes = {
        "index_columns": ["task"],
        "column_indexes": [_pandas_column(None, "unicode", "object")],
        "columns": [
            _pandas_column("task_index", "int64", "int64"),
            _pandas_column("task", "unicode", "object"),
        ],
    }
    table = table.replace_schema_metadata({"pandas": json.dumps(notes)})
    pq.write_table(table, path, compression=_COMPRESSION)


def _pandas_column(name: str | None, pandas_type: str, numpy_type: str) -> dict[str, object]:
    metadata = {"encoding": "UTF-8"} if name is None else None
    return {
        "name": name,
        "field_name": name,
        "pandas_type": pandas_type,
        "numpy_type": numpy_type,
        "metadata": metadata,
    }


PixelFormat = Literal["yuv444p", "yuv420p"]
PIXEL_FORMATS: tuple[PixelFormat, ...] = get_args(PixelFormat)

_QUALITY = {"yuv444p": {"qp": "0"}, "yuv420p": {"crf": "12"}}
_BYTES_PER_FRAME = 64  # generous share of the file's tables
MAX_FRAMES = 100_000  # in a file: of each one about 70 bytes stay in memory until it is closed


class NumberedVideo:
    """The videos of one feature; a context manager.

    Each episode begins with a frame that needs no other, so reading one never decodes those before. There are
    no frames out of order, and encoders have one thread: the same pictures give the same bytes.

    Args:
        folder: The data set.
        key: Name of the feature.
        fps: Frames a second.
        pixels: Pixel format.
        limit_bytes: A file is closed before it becomes as large.

    Raises:
        MissingExtraError: PyAV is not installed.
    """

    def __init__(self, folder: Path, key: str, *, fps: int, pixels: PixelFormat, limit_bytes: int) -> None:
        self._av = import_av()
        self._folder, self._key = folder, key
        self._fps, self._pixels, self._limit_bytes = fps, pixels, limit_bytes
        self._number: FileNumber | None = None
        self._container: Any = None
        self._stream: Any = None
        self._num_frames = self._num_bytes = self._largest_frame = 0

    def write(self, pictures: np.ndarray, *, num_frames: int) -> tuple[FileNumber, int]:
        """Append an episode.

        Args:
            pictures: Shape (num_frames or 1, 3, height, width), uint8; one picture is shown all the time.
            num_frames: Frames of the episode.

        Returns:
            The number of the file, and the place of the first frame in it.
        """
        expected = num_frames * max(self._largest_frame, _BYTES_PER_FRAME)
        is_full = self._num_bytes + expected >= self._limit_bytes or self._num_frames >= MAX_FRAMES
        if self._number is None or is_full:
            self._begin()
        assert self._number is not None  # `_begin` has set it
        place = self._number, self._num_frames
        kinds = self._av.video.frame.PictureType
        frame: Any = None
        for index in range(num_frames):
            if index < len(pictures):
                picture = np.ascontiguousarray(channels_last(pictures[index]))
                frame = self._av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.pict_type = self._num_frames, kinds.NONE if index else kinds.I
            self._mux(self._stream.encode(frame))
            self._num_frames += 1
        return place

    def close(self) -> None:
        """Finish the present file."""
        if self._container is not None:
            self._mux(self._stream.encode(None))
            self._container.close()
            self._container = self._stream = None

    def __enter__(self) -> "NumberedVideo":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        elif self._container is not None:
            with contextlib.suppress(OSError):  # the first error is the one to report
                self._container.close()

    def _begin(self) -> None:
        self.close()
        self._number = self._number.next() if self._number else FileNumber()
        self._num_frames = self._num_bytes = 0
        path = self._number.path(self._folder, VIDEO_PATH, video_key=self._key)
        self._container, self._stream = open_video(path, self._fps)
        self._stream.height, self._stream.width = IMAGE_SHAPE
        self._stream.pix_fmt = self._pixels
        # Without look-ahead a frame's bytes come at once, which the limit on files needs. The faster preset
        # costs 6 % in bytes and saves a third of the time.
        self._stream.options = {
            "preset": "superfast",
            "tune": "zerolatency",
            "threads": "1",
            "forced-idr": "1",
            **_QUALITY[self._pixels],
        }

    def _mux(self, packets: list[Any]) -> None:
        for packet in packets:
            self._largest_frame = max(self._largest_frame, packet.size + _BYTES_PER_FRAME)
            self._num_bytes += packet.size + _BYTES_PER_FRAME
        self._container.mux(packets)


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
        data_file_mb: int = DATA_FILE_MB,
        video_file_mb: int = VIDEO_FILE_MB,
    ) -> None:
        self._folder, self._frames, self._fps, self._pixels = folder, frames, fps, pixels
        self._limits = {"data_files_size_in_mb": data_file_mb, "video_files_size_in_mb": video_file_mb}
        self._schema = _schema(frames)
        self._tasks: dict[str, int] = {}
        self._num_episodes = self._num_frames = 0
        self._row_schema: pa.Schema | None = None  # of the list of episodes; its first row gives it
        self._row_bytes = 0
        self._pixel_counts = {key: np.zeros((3, 256), np.int64) for key in frames.video_keys}
        self._closing = contextlib.ExitStack()
        data_bytes, video_bytes = (limit * BYTES_PER_MB for limit in self._limits.values())
        self._data, self._episodes = (
            self._closing.enter_context(NumberedTable(folder, pattern, limit_bytes=data_bytes))
            for pattern in (DATA_PATH, EPISODES_PATH)
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
        places: dict[str, Any] = {}
        statistics = {}
        for key, pictures in self._frames.pictures(demo).items():  # type: ignore[arg-type]  # as above
            number, first_frame = self._videos[key].write(pictures, num_frames=demo.num_steps)
            counts = count_pixels(pictures, demo.num_steps)
            self._pixel_counts[key] += counts
            statistics[key] = pixel_statistics(counts, demo.num_steps)
            places |= {
                f"videos/{key}/chunk_index": number.chunk,
                f"videos/{key}/file_index": number.file,
                f"videos/{key}/from_timestamp": first_frame / self._fps,
                f"videos/{key}/to_timestamp": (first_frame + demo.num_steps) / self._fps,
            }
        return places, statistics

    def _write_episode(self, row: dict[str, Any]) -> None:
        """Append a row to the list of episodes, which says itself in which file it is."""
        number = self._episodes.place(self._row_bytes)
        own_place = {"meta/episodes/chunk_index": number.chunk, "meta/episodes/file_index": number.file}
        table = pa.Table.from_pylist([row | own_place], schema=self._row_schema)
        self._episodes.write(table, number)
        self._row_schema, self._row_bytes = table.schema, max(self._row_bytes, table.nbytes)

    def _write_metadata(self) -> None:
        info = {
            "codebase_version": CODEBASE_VERSION,
            "robot_type": ROBOT_TYPE,
            "total_episodes": self._num_episodes,
            "total_frames": self._num_frames,
            "total_tasks": len(self._tasks),
            "chunks_size": FILES_PER_CHUNK,
            **self._limits,
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
