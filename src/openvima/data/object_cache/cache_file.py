"""One file of tokens: an Arrow file without compression, whose tables are read in place.

Only the images are compressed, those of an episode together, so that any episode can be read by itself.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.atomic_io import atomic_write
from openvima.data.object_cache.episode import (
    ACTION_PARTS,
    COUNT,
    IMAGE_SIZES,
    KINDS,
    OBJECT_WIDTH,
    PROMPT_WIDTH,
    STEP_WIDTH,
    InputKind,
    PreprocessedEpisode,
)
from openvima.data.shard import ODD_ERRORS
from openvima.errors import ShardError

CACHE_VERSION = 2  # grows whenever the same demonstration gives other tokens
IMAGE_CODEC = "lz4_raw"  # blocks, without the frame around them
_KEY = b"openvima.tokens"


def _table(name: str, dtype: pa.DataType, width: int, meaning: str) -> pa.Field:
    row = pa.list_(pa.field("item", dtype, nullable=False), width)
    column = pa.list_(pa.field("item", row, nullable=False))
    return pa.field(name, column, nullable=False, metadata={"columns": meaning})


_BOX = "front x, front y, front height, front width, top x, top y, top height, top width"
COLUMNS = pa.schema(
    [
        pa.field("task", pa.string(), nullable=False),
        pa.field("seed", pa.int64(), nullable=False),
        pa.field("text", pa.string(), nullable=False),
        pa.field("end_effector", pa.int8(), nullable=False),
        _table("prompt_counts", pa.int32(), 1, "objects of a prompt image"),
        _table("prompt", pa.int16(), PROMPT_WIDTH, f"id, front image, top image, {_BOX}"),
        _table(
            "steps", pa.int16(), STEP_WIDTH, f"objects, picked id, place id, false front, false top, {_BOX}"
        ),
        _table(
            "objects",
            pa.int16(),
            OBJECT_WIDTH,
            f"id, front image, top image, {_BOX}, front grasp x, front grasp y, top grasp x, top grasp y",
        ),
        _table("final", pa.int16(), PROMPT_WIDTH, f"id, front image, top image, {_BOX}"),
        _table("actions", pa.float32(), 12, ", ".join(ACTION_PARTS)),
        pa.field("num_images", pa.int32(), nullable=False),
        pa.field("images", pa.large_binary(), nullable=False, metadata={"codec": IMAGE_CODEC}),
    ]
)
_TABLES = ("prompt_counts", "prompt", "steps", "objects", "final", "actions")


def write_cache_file(
    path: Path, episodes: Sequence[PreprocessedEpisode], kind: InputKind, source: str, boxes: str = ""
) -> None:
    """Write one file.

    Args:
        path: The file; it bears its name only once it is whole.
        episodes: What to write.
        kind: What their images show.
        source: Content hash of the demonstrations that they were made of.
        boxes: Name of what found the objects; empty for the segmentation.
    """
    codec = pa.Codec(IMAGE_CODEC)
    columns = {
        "task": [episode.task for episode in episodes],
        "seed": [episode.seed for episode in episodes],
        "text": [episode.text for episode in episodes],
        "end_effector": [episode.end_effector for episode in episodes],
        "num_images": [len(episode.images) for episode in episodes],
        "images": [codec.compress(np.ascontiguousarray(e.images), asbytes=True) for e in episodes],
    }
    arrays = [
        _ragged([getattr(episode, field.name) for episode in episodes], field.type)
        if field.name in _TABLES
        else pa.array(columns[field.name], field.type)
        for field in COLUMNS
    ]
    about = {"version": CACHE_VERSION, "kind": kind, "source": source, **({"boxes": boxes} if boxes else {})}
    schema = COLUMNS.with_metadata({_KEY: json.dumps(about, sort_keys=True).encode()})
    with atomic_write(path) as file, pa.ipc.new_file(file, schema) as writer:
        writer.write_batch(pa.record_batch(arrays, schema=schema))


class CacheFile:
    """Reads one file of tokens, in place.

    Args:
        path: The file.

    Raises:
        ShardError: It is missing, damaged, or holds something else.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            reader = pa.ipc.open_file(pa.memory_map(str(path)))
            about = json.loads((reader.schema.metadata or {})[_KEY])
            self.kind: InputKind = about["kind"]
            self.source: str = about["source"]
            self.boxes: str = about.get("boxes", "")
            fits = about["version"] == CACHE_VERSION and self.kind in KINDS and reader.schema.equals(COLUMNS)
            batch = reader.get_batch(0) if fits else None
            if batch is not None:
                batch.validate(full=True)  # offsets that lead out of a buffer would end the process
        except ODD_ERRORS as error:
            raise ShardError(_unfit(path, str(error).splitlines()[0] if str(error) else "empty")) from None
        if batch is None:
            raise ShardError(_unfit(path, "of another version"))
        self._batch = batch
        self._tables = {name: _Table(batch.column(name)) for name in _TABLES}
        self._seeds = batch.column("seed").to_numpy()
        self._end_effectors = batch.column("end_effector").to_numpy()
        self._num_images = batch.column("num_images").to_numpy()
        self._tasks, self._texts = batch.column("task"), batch.column("text")
        self._images = batch.column("images")
        self._codec = pa.Codec(IMAGE_CODEC)
        height, width = IMAGE_SIZES[self.kind]
        self._shape, self._image_bytes = (-1, 3, height, width), 3 * height * width

    def __len__(self) -> int:
        return self._batch.num_rows

    def __getitem__(self, row: int) -> PreprocessedEpisode:
        tables = self._tables
        return PreprocessedEpisode(
            task=self._tasks[row].as_py(),
            seed=int(self._seeds[row]),
            text=self._texts[row].as_py(),
            end_effector=int(self._end_effectors[row]),
            prompt_counts=tables["prompt_counts"][row][:, 0],
            prompt=tables["prompt"][row],
            steps=tables["steps"][row],
            objects=tables["objects"][row],
            final=tables["final"][row],
            actions=tables["actions"][row],
            images=self.images(row),
        )

    def images(self, row: int) -> np.ndarray:
        """Return the images of one episode, shape (K, 3, height, width), uint8."""
        size = int(self._num_images[row]) * self._image_bytes
        packed = self._images[row].as_buffer()
        try:
            pixels = self._codec.decompress(packed, decompressed_size=size) if size else b""
            return np.frombuffer(pixels, np.uint8).reshape(self._shape)
        except ODD_ERRORS as error:
            raise ShardError(_unfit(self.path, f"images of row {row}: {error}")) from None

    def image_counts(self) -> np.ndarray:
        """Return the number of images of each episode, shape (rows,), int32."""
        return self._num_images

    def texts(self) -> set[str]:
        """Return the different prompts."""
        return set(self._texts.to_pylist())

    def lengths(self) -> np.ndarray:
        """Return the steps of each episode and the objects in view in all of them, shape (rows, 2), int64."""
        return np.stack([self._tables["steps"].lengths(), self._tables["objects"].lengths()], axis=1)

    def widths(self) -> np.ndarray:
        """Return how many objects the fullest prompt image and the fullest view show, shape (rows, 2)."""
        views = np.maximum(self._tables["steps"].largest(COUNT), self._tables["final"].lengths())
        return np.stack([self._tables["prompt_counts"].largest(0), views], axis=1)


class _Table:
    """A column of tables with the same width, as one array and where each table begins."""

    def __init__(self, column: pa.ListArray) -> None:
        self._starts = column.offsets.to_numpy()
        width = column.type.value_type.list_size
        self._rows = column.values.flatten().to_numpy(zero_copy_only=True).reshape(-1, width)

    def __getitem__(self, row: int) -> np.ndarray:
        return self._rows[self._starts[row] : self._starts[row + 1]]

    def lengths(self) -> np.ndarray:
        return np.diff(self._starts).astype(np.int64)

    def largest(self, column: int) -> np.ndarray:
        """Return the largest number of a column in each table, 0 in an empty one."""
        result = np.zeros(len(self._starts) - 1, np.int64)
        rows = self._rows[self._starts[0] : self._starts[-1], column]
        np.maximum.at(result, np.repeat(np.arange(len(result)), self.lengths()), rows)
        return result


def _ragged(tables: Sequence[np.ndarray], dtype: Any) -> pa.ListArray:  # Any: pyarrow's types are dynamic
    width, item = dtype.value_type.list_size, dtype.value_type.value_type
    starts = np.cumsum([0, *(len(table) for table in tables)])
    numpy_type = item.to_pandas_dtype()
    flat = np.concatenate([np.zeros(0, numpy_type), *(np.ravel(table) for table in tables)])
    rows = pa.FixedSizeListArray.from_arrays(pa.array(flat.astype(numpy_type)), type=dtype.value_type)
    assert len(rows) * width == len(flat)
    return pa.ListArray.from_arrays(pa.array(starts, pa.int32()), rows, type=dtype)


def _unfit(path: Path, reason: str) -> str:
    remedy = "Delete it; `openvima data tokens` makes it anew"
    return f"{path} holds no tokens that can be read ({reason}). {remedy}."
