"""Demonstrations to record batches."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyarrow as pa

from openvima.data.columns import columns_of
from openvima.data.records import Demonstration
from openvima.data.schema import ARRAYS, CODECS, COLUMNS, SCHEMA_VERSION
from openvima.errors import ShardError, unknown_name

_METADATA_KEY = b"openvima"
_LISTS: dict[str, pa.ListType] = {name: COLUMNS.field(name).type for name in (*ARRAYS, "joint_paths")}
_NAMES = COLUMNS.names
# All other columns, to be made at once: each call into Arrow costs some microseconds.
_RECORDS = pa.struct([field for field in COLUMNS if field.name not in (*ARRAYS, "joint_paths")])

SkipKind = Literal["failed", "unsolved", "no_action", "not_sampled"]


@dataclass(frozen=True, slots=True)
class Skipped:
    """A seed that gave no demonstration.

    Args:
        seed: The seed.
        kind: "failed" (the oracle spoilt it), "unsolved" (it ran out of steps), "no_action" (it was at a
            loss) or "not_sampled" (the task found no start).
        reason: Details.
    """

    seed: int
    kind: SkipKind
    reason: str


@dataclass(frozen=True, slots=True)
class ShardInfo:
    """What all rows of a shard have in common; written once a file.

    Args:
        task: Name of the task.
        level: "train" or "L1" to "L4".
        domain: Domain of the seeds.
        number: Which shard of the task, from 0.
        shard_size: Episodes in a full shard; 0 where shards grow with their number.
        first_seed: First seed of the whole data set.
        assets: Name of the asset pack.
        versions: Package name to version.
        compat: Whether the original benchmark was followed also where it is odd.
        difficulty: "easy", "medium" or "hard".
        compression: Codec of the buffers, "lz4" or "zstd".
        images: Whether images are stored; without, they are drawn anew on reading.

    Raises:
        ShardError: There is no such codec.
    """

    task: str
    level: str
    domain: str
    number: int
    shard_size: int
    first_seed: int
    assets: str
    versions: dict[str, str]
    compat: bool = False
    difficulty: str = "easy"
    compression: str = "lz4"
    images: bool = True

    def __post_init__(self) -> None:
        if self.compression not in CODECS:
            raise ShardError(unknown_name("compression", self.compression, CODECS))

    def to_metadata(self) -> dict[bytes, bytes]:
        """Return the entry for the file's schema."""
        fields = {name: getattr(self, name) for name in self.__slots__}
        text = json.dumps({"schema": SCHEMA_VERSION, **fields}, sort_keys=True)
        return {_METADATA_KEY: text.encode()}

    @staticmethod
    def from_metadata(metadata: Mapping[bytes, bytes] | None) -> "ShardInfo":
        """Read the entry of a file's schema.

        Raises:
            ShardError: There is none, it is damaged, or of another version.
        """
        try:
            fields = json.loads((metadata or {}).get(_METADATA_KEY, b"{}"))
            written_as = fields.pop("schema", None)
            if written_as is None:
                raise ShardError("it is an Arrow file, but holds no demonstrations of this package.")
            if written_as != SCHEMA_VERSION:
                raise ShardError(f"it has schema version {written_as}; this package reads {SCHEMA_VERSION}.")
            return ShardInfo(**fields)
        except (UnicodeDecodeError, json.JSONDecodeError, AttributeError, TypeError) as error:
            raise ShardError(f"what it says of itself is damaged ({error}).") from None


def encode(
    demo: Demonstration, skipped: Sequence[Skipped] = (), *, with_images: bool = True
) -> pa.RecordBatch:
    """Make one row of a demonstration.

    Args:
        demo: The demonstration.
        skipped: Seeds tried just before it in vain.
        with_images: Store what the cameras saw and the prompt shows; the content hash counts them either way.

    Returns:
        A record batch of one row with the columns of `schema.COLUMNS`.
    """
    columns = columns_of(demo)
    records = {
        **columns.records,
        "content_hash": columns.content_hash,
        "skipped": [{"seed": s.seed, "kind": s.kind, "reason": s.reason} for s in skipped],
    }
    images = {name: array if with_images else array[:0] for name, array in columns.images.items()}
    arrays = {**columns.arrays, **images}
    cells: dict[str, pa.Array] = {
        "joint_paths": _nested_cell(arrays.pop("joint_paths"), columns.path_lengths)
    }
    cells |= {name: _list_cell(array, _LISTS[name]) for name, array in arrays.items()}
    plain = pa.array([records], type=_RECORDS).flatten()
    cells |= {field.name: cell for field, cell in zip(_RECORDS, plain, strict=True)}
    return pa.RecordBatch.from_arrays([cells[name] for name in _NAMES], schema=COLUMNS)


def _list_cell(array: np.ndarray, dtype: pa.ListType) -> pa.ListArray:
    """A column of one row that lists arrays of one shape, without a copy."""
    items = _fixed_lists(array, dtype.value_type)
    return _lists(np.array([0, len(items)], np.int32), items, dtype)


def _nested_cell(array: np.ndarray, lengths: Sequence[int]) -> pa.ListArray:
    """The column of joint paths of one row, without a copy."""
    ends = np.cumsum([0, *lengths], dtype=np.int32)
    steps = _LISTS["joint_paths"].value_type
    paths = _lists(ends, _fixed_lists(array, steps.value_type), steps)
    return _lists(np.array([0, len(lengths)], np.int32), paths, _LISTS["joint_paths"])


def _lists(offsets: np.ndarray, items: pa.Array, dtype: pa.ListType) -> pa.ListArray:
    return pa.Array.from_buffers(
        dtype, len(offsets) - 1, [None, pa.py_buffer(offsets)], null_count=0, children=[items]
    )


def _fixed_lists(array: np.ndarray, dtype: pa.FixedSizeListType) -> pa.FixedSizeListArray:
    flat = pa.Array.from_buffers(dtype.value_type, array.size, [None, pa.py_buffer(array)], null_count=0)
    return pa.Array.from_buffers(dtype, array.size // dtype.list_size, [None], null_count=0, children=[flat])
