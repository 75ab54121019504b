"""One shard: a file of demonstrations, its checksums, reading and writing.

A shard is a head (magic bytes and schema), records one after the other, and a tail (the footer that says
where they are). The index holds a CRC-32 of each record, the manifest one of head and tail together: Arrow
then never sees a damaged byte, on which it may fail in many ways, and a flipped pixel does not go unnoticed.
"""

import contextlib
import itertools
import shlex
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from openvima.atomic_io import atomic_path
from openvima.data.encoding import ShardInfo, Skipped, decode, decode_columns, encode
from openvima.data.records import Demonstration, make_columns
from openvima.data.schema import COLUMNS, IMAGES, SCHEMA_VERSION
from openvima.errors import DatasetError, unknown_name

# What Arrow raises when it is given damaged bytes.
DAMAGE_ERRORS = (pa.ArrowException, OSError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError)
COMPRESSION_LEVELS = {"zstd": 3}  # higher ones are much slower for a few percent
_MAGIC_BYTES = 8  # "ARROW1" and padding, before the first message
_BUFFER_BYTES = 1 << 20  # Arrow writes an episode in 150 pieces


# Columns of the index: where a record lies in its file, and the CRC-32 of its bytes.
SPAN = ("offset", "num_bytes", "crc32")


def map_file(path: Path) -> memoryview:
    """Map a file into memory; its bytes are read when they are touched.

    Raises:
        FileNotFoundError: There is no regular file; to open a pipe would block.
    """
    if not path.is_file():
        raise FileNotFoundError(path)
    with pa.memory_map(str(path)) as file:  # the buffer keeps the mapping
        return memoryview(file.read_buffer())


def measure(path: Path) -> tuple[dict[str, int], list[tuple[int, int, int]]]:
    """Find the parts of a whole shard and their checksums.

    Returns:
        What lies around the records, as the manifest names it: `bytes`, the size of the whole file,
        `head_bytes` before the first record, `tail_bytes` after the last one, and `frame_crc32`, the CRC-32
        of head and tail; and `SPAN` of each record.
    """
    content, ends = map_file(path), []
    with pa.memory_map(str(path)) as file:
        file.seek(_MAGIC_BYTES)
        with contextlib.suppress(EOFError):  # the mark after the last record
            while pa.ipc.read_message(file):
                ends.append(file.tell())
    spans = [(start, end - start, zlib.crc32(content[start:end])) for start, end in itertools.pairwise(ends)]
    frame = {"bytes": len(content), "head_bytes": ends[0], "tail_bytes": len(content) - ends[-1]}
    return {**frame, "frame_crc32": _frame_crc32(content, frame)}, spans


def _frame_crc32(content: memoryview, frame: Mapping[str, Any]) -> int:
    tail = content[len(content) - frame["tail_bytes"] :]
    return zlib.crc32(tail, zlib.crc32(content[: frame["head_bytes"]]))


def _find_fault(content: memoryview, entry: Mapping[str, Any]) -> str:
    """Say what is wrong around the records in a file's content; nothing if all is as it was."""
    if len(content) != entry["bytes"]:
        return f"it has {len(content):,} of {entry['bytes']:,} bytes"
    is_same = _frame_crc32(content, entry) == entry["frame_crc32"]
    return "" if is_same else "the checksum of its schema and footer is wrong"


class Shard:
    """One file of demonstrations; rows are read on demand.

    Damage that keeps Arrow from reading is an error in any case. Changed pixels and numbers are noticed where
    checksums are given, as `Dataset` does, and by `openvima data verify`.

    Args:
        path: The file.
        entry: What the folder's manifest says of it, with the checksum of all that surrounds the records.

    Raises:
        DatasetError: It is missing, truncated, damaged, or no shard of this package.
    """

    def __init__(self, path: Path, entry: Mapping[str, Any] | None = None) -> None:
        self.path = path
        try:
            self._content = map_file(path)
        except FileNotFoundError:
            raise DatasetError(f"there is no file {path}. {remedy(path.parent)}") from None
        except DAMAGE_ERRORS as error:
            raise self._damage("it", error) from None
        if entry is not None and (fault := _find_fault(self._content, entry)):
            raise self._damage("it", fault)
        self._readers: dict[tuple[str, ...], pa.RecordBatchFileReader] = {}  # of some columns each
        whole = self._open(COLUMNS.names)
        self._num_rows = whole.num_record_batches
        try:
            self.info = ShardInfo.from_metadata(whole.schema.metadata)  # what all rows have in common
        except DatasetError as error:
            raise DatasetError(f"{path}: {error}") from None
        if not whole.schema.equals(COLUMNS):
            raise DatasetError(f"{path} has other columns than schema version {SCHEMA_VERSION} asks for.")

    def __len__(self) -> int:
        return self._num_rows

    def __getitem__(self, row: int) -> Demonstration:
        batch = self.batch(row)
        try:
            demo = decode(batch, self.info)
        except DAMAGE_ERRORS as error:
            raise self._row_damage(row, error) from None
        if self.info.images:
            return demo
        from openvima.data.rerender import rerender  # with which the renderer comes

        try:
            return rerender(demo, self.info, batch.column("content_hash")[0].as_py())
        except DatasetError as error:
            raise DatasetError(f"{self.path}, record {row}: {error}") from None

    def read(self, row: int, columns: Sequence[str]) -> dict[str, Any]:
        """Read some columns of one row; nothing is decompressed for the others.

        Args:
            row: The row.
            columns: Names out of `schema.COLUMNS`; docs/format.md lists them.

        Returns:
            Column name to value: an array for poses, actions and images (colours last, as they are stored), a
            list of arrays for joint paths, and else texts, numbers, lists and dictionaries. Arrays are
            read-only.

        Raises:
            DatasetError: There is no such column.
            DatasetError: The row is damaged.
        """
        batch = self.batch(row, (*columns, "steps") if "poses" in columns else columns)
        try:
            values = decode_columns(batch)
        except DAMAGE_ERRORS as error:
            raise self._row_damage(row, error) from None
        if not self.info.images and IMAGES.intersection(columns):
            _, arrays = make_columns(self[row])
            values |= {name: arrays[name] for name in IMAGES}
        return {name: values[name] for name in columns}

    def batch(self, row: int, columns: Sequence[str] = COLUMNS.names) -> pa.RecordBatch:
        """Read one row, or some columns of it, as it is stored.

        Raises:
            IndexError: There are fewer rows.
            DatasetError: It is damaged.
        """
        reader = self._open(columns)
        if not 0 <= row < len(self):  # which also ends loops over a shard
            raise IndexError(f"record {row} of {len(self)} in {self.path}; count from 0 to {len(self) - 1}.")
        try:
            batch = reader.get_batch(row)
            batch.validate(full=True)  # 4 µs; offsets that lead out of a buffer would end the process
        except DAMAGE_ERRORS as error:
            raise self._row_damage(row, error) from None
        return batch

    def check(self, row: int, offset: int, num_bytes: int, crc32: int) -> None:
        """Compare the bytes of a row with their checksum, before anything is made of them.

        Args:
            row: The row.
            offset: Where it lies in the file, as the index says.
            num_bytes: Their number.
            crc32: Their checksum.

        Raises:
            DatasetError: They are damaged.
        """
        if zlib.crc32(self._content[offset : offset + num_bytes]) != crc32:
            raise self._row_damage(row, "its checksum is wrong")

    def table(self, names: Sequence[str]) -> pa.Table:
        """Read some columns of all rows, without touching the others.

        Args:
            names: Columns of `schema.COLUMNS`.
        """
        try:
            table = self._open(names).read_all()
            table.validate(full=True)  # as for a row
        except DAMAGE_ERRORS as error:
            raise self._damage("its records", error) from None
        return table.select(list(names))

    def _open(self, columns: Sequence[str]) -> pa.RecordBatchFileReader:
        """Return a reader to which the other columns do not exist; to open one takes 0.2 ms.

        Raises:
            DatasetError: There is no such column.
            DatasetError: The file is damaged.
        """
        key = tuple(dict.fromkeys(columns))
        if key not in self._readers:
            for name in key:
                if name not in COLUMNS.names:
                    raise DatasetError(unknown_name("column", name, COLUMNS.names))
            numbers = sorted(map(COLUMNS.get_field_index, key))
            included = None if len(numbers) == len(COLUMNS) else numbers
            options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=included)
            try:
                self._readers[key] = pa.ipc.open_file(pa.py_buffer(self._content), options=options)
            except DAMAGE_ERRORS as error:
                raise self._damage("it", error) from None
        return self._readers[key]

    def _row_damage(self, row: int, error: Exception | str) -> DatasetError:
        return self._damage(f"record {row} of {len(self)}", error)

    def _damage(self, what: str, error: Exception | str) -> DatasetError:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        return DatasetError(
            f"{self.path}: {what} is truncated, damaged or no shard ({reason}). {remedy(self.path.parent)}"
        )


def remedy(folder: Path) -> str:
    """Return a sentence that says what to do about a damaged folder."""
    return f"`openvima data verify {shlex.quote(str(folder))}` names all damage, and what makes it again."


class ShardWriter(contextlib.ExitStack):
    """Writes one shard; a context manager.

    The file gets its name when the block ends without an exception, so a file with that name is whole. After
    an exception nothing is left; after a crash a hidden temporary file is, which the next run deletes.

    Args:
        path: Final name of the shard.
        info: What all its rows have in common.
    """

    def __init__(self, path: Path, info: ShardInfo) -> None:
        super().__init__()
        self._schema = COLUMNS.with_metadata(info.to_metadata())
        self._has_images = info.images
        codec = pa.Codec(info.compression, compression_level=COMPRESSION_LEVELS.get(info.compression))
        options = pa.ipc.IpcWriteOptions(compression=codec, use_threads=False)
        file = pa.OSFile(str(self.enter_context(atomic_path(path))), "wb")
        stream = self.enter_context(pa.BufferedOutputStream(file, _BUFFER_BYTES))
        self._writer = self.enter_context(pa.ipc.new_file(stream, self._schema, options=options))

    def write(self, demo: Demonstration, skipped: Sequence[Skipped] = ()) -> None:
        """Append one episode.

        Args:
            demo: The demonstration.
            skipped: Seeds tried just before it in vain.
        """
        self.copy(encode(demo, skipped, with_images=self._has_images))

    def copy(self, batch: pa.RecordBatch) -> None:
        """Append one episode as another shard holds it.

        Args:
            batch: The row, as `Shard.batch` gives it.
        """
        self._writer.write_batch(batch.replace_schema_metadata(self._schema.metadata))
