"""Reading one shard of demonstrations."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from openvima.atomic_io import NO_SPACE
from openvima.data.checksums import Envelope, Span, mapped
from openvima.data.decoding import actions_in, decode, decode_columns
from openvima.data.encoding import ShardInfo
from openvima.data.image_layout import planes
from openvima.data.record_stream import decode_record
from openvima.data.records import Demonstration, Step, columns_of
from openvima.data.schema import COLUMNS, IMAGES, SCHEMA_VERSION, VIEWS
from openvima.errors import DatasetError, ShardError, unknown_name
from openvima.scene import ACTION_SHAPES, END_EFFECTORS

# What Arrow raises when it is given damaged bytes.
ODD_ERRORS = (pa.ArrowException, OSError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError)


class Shard:
    """One file of demonstrations; rows are read on demand.

    Damage that keeps Arrow from reading is an error in any case. Changed pixels and numbers are noticed where
    checksums are given, as `Dataset` does, and by `openvima data verify`.

    Args:
        path: The file.
        envelope: Checksum of all that surrounds the records, as the folder's manifest holds it.

    Raises:
        ShardError: It is missing, truncated, damaged, or no shard of this package.
    """

    def __init__(self, path: Path, envelope: Envelope | None = None) -> None:
        self.path = path
        self._content = _mapped(path)
        if envelope is not None and (fault := envelope.fault_in(self._content)):
            raise ShardError(_damaged(path, "it", fault))
        self._readers: dict[tuple[str, ...], pa.RecordBatchFileReader] = {}  # of some columns each
        self._info: ShardInfo | None = None
        self._checked: tuple[int, Span | None] = -1, None  # the row whose checksum was compared last
        if envelope is None:
            _ = self.info

    @property
    def info(self) -> ShardInfo:
        """What all rows have in common."""
        if self._info is None:
            self._reader_of(COLUMNS.names)
        assert self._info is not None  # opening sets it
        return self._info

    def __len__(self) -> int:
        reader = next(iter(self._readers.values()), None) or self._reader_of(COLUMNS.names)
        return reader.num_record_batches

    def __getitem__(self, row: int) -> Demonstration:
        batch = self.batch(row)
        try:
            demo = decode(batch, self.info)
        except ODD_ERRORS as error:
            raise self._row_error(row, error) from None
        if self.info.images:
            return demo
        from openvima.data.rerender import rerendered  # with which the renderer comes

        try:
            return rerendered(demo, self.info, batch.column("content_hash")[0].as_py())
        except ShardError as error:
            raise ShardError(f"{self.path}, record {row}: {error}") from None

    def read(self, row: int, columns: Sequence[str]) -> dict[str, Any]:  # Any: one column, one type
        """Read some columns of one row; nothing is decompressed for the others.

        Args:
            row: The row.
            columns: Names out of `schema.COLUMNS`; docs/format.md lists them.

        Returns:
            Column name to value: an array for poses, actions and images (colours last, as they are stored), a
            list of arrays for joint paths, and else texts, numbers, lists and dictionaries.

        Raises:
            DatasetError: There is no such column.
            ShardError: The row is damaged.
        """
        needed = tuple(dict.fromkeys((*columns, "steps") if "poses" in columns else columns))
        checked, span = self._checked
        if checked == row and span is not None:
            batch = self._decoded(row, span, needed)
        else:
            batch = self._batch(self._reader_of(needed), row)
        try:
            values = decode_columns(batch)
        except ODD_ERRORS as error:
            raise self._row_error(row, error) from None
        images = IMAGES.intersection(columns)
        if images and not any(len(values[name]) for name in images) and not self.info.images:
            values |= columns_of(self[row]).images
        return {name: values[name] for name in columns}

    def step(self, row: int, step: int, *, views: Sequence[str] = VIEWS, segm: bool = True) -> Step:
        """Read one step of one row.

        Args:
            row: The row.
            step: Which one, from 0.
            views: What of "front" and "top" to read.
            segm: Whether to read segmentation too.

        Raises:
            IndexError: The episode has fewer steps.
            DatasetError: There is no such view.
            ShardError: The row is damaged.
        """
        for view in views:
            if view not in VIEWS:
                raise DatasetError(unknown_name("view", view, VIEWS))
        kinds = ("rgb", "segm") if segm else ("rgb",)
        images = [f"{kind}_{view}" for kind in kinds for view in views]
        values = self.read(row, [*images, *ACTION_SHAPES, "end_effector"])
        actions = actions_in(values)
        if not 0 <= step < len(actions):
            raise IndexError(f"step {step} of {len(actions)}; count from 0 to {len(actions) - 1}.")
        observation: dict[str, Any] = {  # Any: as an environment's
            "rgb": {view: planes(values[f"rgb_{view}"][step : step + 1])[0] for view in views},
            "ee": END_EFFECTORS.index(values["end_effector"]),
        }
        if segm:
            observation["segm"] = {view: values[f"segm_{view}"][step] for view in views}
        return Step(observation, actions[step])

    def batch(self, row: int) -> pa.RecordBatch:
        """Read one row as it is stored.

        Raises:
            IndexError: There are fewer rows.
            ShardError: It is damaged.
        """
        return self._batch(self._reader_of(COLUMNS.names), row)

    def _batch(self, reader: pa.RecordBatchFileReader, row: int) -> pa.RecordBatch:
        if not 0 <= row < len(self):  # which also ends loops over a shard
            raise IndexError(f"record {row} of {len(self)} in {self.path}; count from 0 to {len(self) - 1}.")
        try:
            batch = reader.get_batch(row)
            batch.validate(full=True)  # 4 µs; offsets that lead out of a buffer would end the process
        except ODD_ERRORS as error:
            raise self._row_error(row, error) from None
        return batch

    def _decoded(self, row: int, span: Span, columns: Sequence[str]) -> pa.RecordBatch:
        """Read some columns of a row that was checked, without opening the file for it."""
        for name in columns:
            if name not in COLUMNS.names:
                raise DatasetError(unknown_name("column", name, COLUMNS.names))
        try:
            return decode_record(self._content[span.offset : span.offset + span.num_bytes], columns)
        except ODD_ERRORS as error:
            raise self._row_error(row, error) from None

    def check(self, row: int, span: Span) -> None:
        """Compare the bytes of a row with their checksum, before anything is made of them.

        The next call of `read` for this row does without opening the file.

        Args:
            row: The row.
            span: Where the index says that it lies.

        Raises:
            ShardError: They are damaged.
        """
        if fault := span.fault_in(self._content):
            raise self._row_error(row, fault)
        self._checked = row, span

    def table(self, names: Sequence[str]) -> pa.Table:
        """Read some columns of all rows, without touching the others.

        Args:
            names: Columns of `schema.COLUMNS`.
        """
        try:
            table = self._reader_of(names).read_all()
            table.validate(full=True)  # as for a row
        except ODD_ERRORS as error:
            raise ShardError(_damaged(self.path, "its records", error)) from None
        return table.select(list(names))

    def _reader_of(self, columns: Sequence[str]) -> pa.RecordBatchFileReader:
        """A reader to which the other columns do not exist; to open one takes 0.2 ms.

        Raises:
            DatasetError: There is no such column.
            ShardError: The file is damaged, or has other columns.
        """
        key = tuple(columns)
        if key not in self._readers:
            for name in columns:
                if name not in COLUMNS.names:
                    raise DatasetError(unknown_name("column", name, COLUMNS.names))
            numbers = [COLUMNS.get_field_index(name) for name in columns]
            reader = _opened(self.path, self._content, None if len(numbers) == len(COLUMNS) else numbers)
            self._info = self._info or self._described(reader)
            if not reader.schema.equals(pa.schema([COLUMNS.field(number) for number in sorted(numbers)])):
                raise ShardError(
                    f"{self.path} has other columns than schema version {SCHEMA_VERSION} asks for."
                )
            self._readers[key] = reader
        return self._readers[key]

    def _described(self, reader: pa.RecordBatchFileReader) -> ShardInfo:
        try:
            return ShardInfo.from_metadata(reader.schema.metadata)
        except ShardError as error:
            raise ShardError(f"{self.path}: {error}") from None

    def _row_error(self, row: int, error: Exception | str) -> ShardError:
        if isinstance(error, OSError) and error.errno in NO_SPACE:
            raise error  # nothing is damaged: Numba keeps what it compiled on a full disk
        return ShardError(_damaged(self.path, f"record {row} of {len(self)}", error))


def remedy(folder: Path) -> str:
    """Return a sentence that says what makes a damaged folder whole."""
    return (
        f"`openvima data verify {shlex.quote(str(folder))} --repair` makes it anew, or keeps what is whole."
    )


def _mapped(path: Path) -> memoryview:
    try:
        return mapped(path)
    except FileNotFoundError:
        raise ShardError(f"there is no file {path}. {remedy(path.parent)}") from None
    except ODD_ERRORS as error:
        raise ShardError(_damaged(path, "it", error)) from None


def _opened(path: Path, content: memoryview, columns: list[int] | None = None) -> pa.RecordBatchFileReader:
    options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=columns)
    try:
        return pa.ipc.open_file(pa.py_buffer(content), options=options)
    except ODD_ERRORS as error:
        raise ShardError(_damaged(path, "it", error)) from None


def _damaged(path: Path, what: str, error: Exception | str) -> str:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return f"{path}: {what} is truncated, damaged or no shard ({reason}). {remedy(path.parent)}"
