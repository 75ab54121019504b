"""One file of the object cache: an uncompressed Arrow file whose tables are memory-mapped.

Tables are lists of structs with fields of fixed width, so each field of all episodes is one array. Only the
images are compressed, those of an episode together, so that any episode can be read by itself.
"""

import json
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.atomic_io import atomic_write
from openvima.data.object_cache.episode import ACTION_PARTS, FalsePositives, PreprocessedEpisode
from openvima.data.shard import ODD_ERRORS
from openvima.errors import ShardError
from openvima.perception.preprocessing import (
    IMAGE_SIZES,
    KINDS,
    InputKind,
    ObjectTable,
    PreprocessedPrompt,
)

CACHE_VERSION = 3  # grows whenever the same demonstration gives another record
IMAGE_CODEC = "lz4_raw"  # blocks, without the frame around them
_KEY = b"openvima.object_cache"


def _field(name: str, dtype: pa.DataType, *shape: int, meaning: str) -> pa.Field:
    """Describe a field of fixed shape."""
    for size in reversed(shape):
        dtype = pa.list_(pa.field("item", dtype, nullable=False), size)
    return pa.field(name, dtype, nullable=False, metadata={"meaning": meaning})


def _table(name: str, *fields: pa.Field) -> pa.Field:
    return pa.field(name, pa.list_(pa.field("item", pa.struct(fields), nullable=False)), nullable=False)


_BOXES = "front and top view: centre x, centre y, height, width in pixels"
_OBJECT = (
    _field("id", pa.int16(), meaning="segmentation value, or rank in the image where it was detected"),
    _field("crop_index", pa.int32(), 2, meaning="front and top view: index of the image, 0 where hidden"),
    _field("boxes", pa.int16(), 2, 4, meaning=_BOXES),
    _field("grasps", pa.int16(), 2, 2, meaning="front and top view: column and row"),
)
COLUMNS = pa.schema(
    [
        pa.field("task", pa.string(), nullable=False),
        pa.field("seed", pa.int64(), nullable=False),
        pa.field("end_effector", pa.int8(), nullable=False),
        pa.field("text", pa.string(), nullable=False),
        _table("prompt_objects", *_OBJECT),
        _table(
            "prompt_images",
            _field("num_objects", pa.int16(), meaning="rows of prompt_objects"),
            _field("is_scene", pa.uint8(), meaning="1 for a scene, 0 for one object on white"),
        ),
        _table("objects", *_OBJECT),
        _table(
            "steps",
            _field("num_objects", pa.int16(), meaning="rows of objects"),
            _field("pick_id", pa.int16(), meaning="object to pick"),
            _field("place_id", pa.int16(), meaning="object to place at"),
            _field("false_positive_crop_index", pa.int32(), 2, meaning="front and top view"),
            _field("false_positive_boxes", pa.int16(), 2, 4, meaning=_BOXES),
            _field("action", pa.float32(), 12, meaning=", ".join(ACTION_PARTS)),
        ),
        _table("final_objects", *_OBJECT),
        pa.field("num_images", pa.int32(), nullable=False),
        pa.field("images", pa.large_binary(), nullable=False, metadata={"codec": IMAGE_CODEC}),
    ]
)
_TABLES = ("prompt_objects", "prompt_images", "objects", "steps", "final_objects")


def write_cache_file(
    path: Path, episodes: Sequence[PreprocessedEpisode], kind: InputKind, source: str, boxes: str = ""
) -> None:
    """Write one file.

    Args:
        path: The file; it bears its name only once it is whole.
        episodes: What to write.
        kind: What their images show.
        source: Content hash of the demonstrations that they were made of.
        boxes: Name of the extractor of the objects; empty for the segmentation.
    """
    codec = pa.Codec(IMAGE_CODEC)
    columns = {
        "task": [episode.task for episode in episodes],
        "seed": [episode.seed for episode in episodes],
        "end_effector": [episode.end_effector for episode in episodes],
        "text": [episode.prompt.text for episode in episodes],
        "num_images": [len(episode.images) for episode in episodes],
        "images": [codec.compress(np.ascontiguousarray(e.images), asbytes=True) for e in episodes],
    }
    tables = [_tables_of(episode) for episode in episodes]
    arrays = [
        _write_table([episode[field.name] for episode in tables], field.type)
        if field.name in _TABLES
        else pa.array(columns[field.name], field.type)
        for field in COLUMNS
    ]
    about = {"version": CACHE_VERSION, "kind": kind, "source": source, **({"boxes": boxes} if boxes else {})}
    schema = COLUMNS.with_metadata({_KEY: json.dumps(about, sort_keys=True).encode()})
    with atomic_write(path) as file, pa.ipc.new_file(file, schema) as writer:
        writer.write_batch(pa.record_batch(arrays, schema=schema))


class CacheFile:
    """Reads one file of the object cache, memory-mapped.

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
        _, offsets, self._packed = batch.column("images").buffers()
        self._image_offsets: list[int] = np.frombuffer(offsets, np.int64).tolist()
        self._codec = pa.Codec(IMAGE_CODEC)
        height, width = IMAGE_SIZES[self.kind]
        self._shape, self._image_bytes = (-1, 3, height, width), 3 * height * width

    def __len__(self) -> int:
        return self._batch.num_rows

    def __getitem__(self, row: int) -> PreprocessedEpisode:
        tables = self._tables
        num_objects, is_scene = tables["prompt_images"][row]
        objects_per_step, pick_ids, place_ids, crop_index, boxes, actions = tables["steps"][row]
        return PreprocessedEpisode(
            task=self._tasks[row],
            seed=int(self._seeds[row]),
            end_effector=int(self._end_effectors[row]),
            prompt=PreprocessedPrompt(
                self._texts[row],
                ObjectTable(*tables["prompt_objects"][row]),
                num_objects,
                is_scene.view(np.bool_),
            ),
            objects=ObjectTable(*tables["objects"][row]),
            objects_per_step=objects_per_step,
            pick_ids=pick_ids,
            place_ids=place_ids,
            false_positives=FalsePositives(crop_index, boxes),
            final=ObjectTable(*tables["final_objects"][row]),
            actions=actions,
            images=self.images(row),
        )

    @cached_property
    def _tasks(self) -> list[str]:
        return self._batch.column("task").to_pylist()

    @cached_property
    def _texts(self) -> list[str]:
        return self._batch.column("text").to_pylist()

    def images(self, row: int) -> np.ndarray:
        """Return the images of one episode, shape (K, 3, height, width), uint8."""
        size = int(self._num_images[row]) * self._image_bytes
        start, end = self._image_offsets[row : row + 2]
        packed = self._packed.slice(start, end - start)
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
        return set(self._texts)

    def lengths(self) -> np.ndarray:
        """Return the steps of each episode and the visible objects of all of them, shape (rows, 2), int64."""
        return np.stack([self._tables["steps"].lengths(), self._tables["objects"].lengths()], axis=1)

    def widths(self) -> np.ndarray:
        """Return the most objects in a prompt image and in an observation, shape (rows, 2)."""
        in_view = np.maximum(
            self._tables["steps"].largest("num_objects"), self._tables["final_objects"].lengths()
        )
        return np.stack([self._tables["prompt_images"].largest("num_objects"), in_view], axis=1)


class _Table:
    """A column of tables: each field of all episodes as one array, and where each episode begins."""

    def __init__(self, column: pa.ListArray) -> None:
        self._starts: list[int] = column.offsets.to_pylist()
        structs = column.values
        self._fields = {
            field.name: _to_numpy(structs.field(number)) for number, field in enumerate(structs.type)
        }
        self._arrays = tuple(self._fields.values())

    def __getitem__(self, row: int) -> tuple[np.ndarray, ...]:
        """Return the fields of one episode."""
        start, end = self._starts[row], self._starts[row + 1]
        return tuple([array[start:end] for array in self._arrays])

    def lengths(self) -> np.ndarray:
        return np.diff(self._starts).astype(np.int64)

    def largest(self, name: str) -> np.ndarray:
        """Return the largest value of a field in each table, 0 in an empty one."""
        result = np.zeros(len(self._starts) - 1, np.int64)
        values = self._fields[name][self._starts[0] : self._starts[-1]]
        np.maximum.at(result, np.repeat(np.arange(len(result)), self.lengths()), values)
        return result


def _tables_of(episode: PreprocessedEpisode) -> dict[str, tuple[np.ndarray, ...]]:
    """The fields of an episode's tables, in the order of the schema."""
    prompt, false_positives = episode.prompt, episode.false_positives
    return {
        "prompt_objects": _object_fields(prompt.objects),
        "prompt_images": (prompt.objects_per_image, prompt.is_scene),
        "objects": _object_fields(episode.objects),
        "steps": (
            episode.objects_per_step,
            episode.pick_ids,
            episode.place_ids,
            false_positives.crop_index,
            false_positives.boxes,
            episode.actions,
        ),
        "final_objects": _object_fields(episode.final),
    }


def _object_fields(table: ObjectTable) -> tuple[np.ndarray, ...]:
    return table.ids, table.crop_index, table.boxes, table.grasps


def _write_table(
    tables: Sequence[tuple[np.ndarray, ...]], dtype: Any
) -> pa.ListArray:  # Any: pyarrow's types are dynamic
    struct = dtype.value_type
    columns = [
        _to_arrow(np.concatenate([table[number] for table in tables]), field.type)
        for number, field in enumerate(struct)
    ]
    starts = np.cumsum([0, *(len(table[0]) for table in tables)])
    rows = pa.StructArray.from_arrays(columns, fields=list(struct))
    return pa.ListArray.from_arrays(pa.array(starts, pa.int32()), rows, type=dtype)


def _to_arrow(values: np.ndarray, dtype: Any) -> Any:  # Any: as above
    """Make an array of fixed-size lists, as deep as the type has it."""
    if pa.types.is_fixed_size_list(dtype):
        inner = _to_arrow(values.reshape(-1, *values.shape[2:]), dtype.value_type)
        return pa.FixedSizeListArray.from_arrays(inner, type=dtype)
    return pa.array(values.astype(dtype.to_pandas_dtype()), dtype)


def _to_numpy(array: Any) -> np.ndarray:  # Any: as above
    """Return an array of fixed-size lists in place, without a copy."""
    shape = [len(array)]
    while pa.types.is_fixed_size_list(array.type):
        shape.append(array.type.list_size)
        array = array.flatten()
    return array.to_numpy(zero_copy_only=True).reshape(shape)


def _unfit(path: Path, reason: str) -> str:
    remedy = "Delete it; `openvima data preprocess` makes it anew"
    return f"{path} is no readable file of the object cache ({reason}). {remedy}."
