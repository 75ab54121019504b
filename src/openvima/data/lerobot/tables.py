"""Parquet files: rows of frames and of episodes, spread over numbered files, and the list of prompts."""

import json
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from openvima.data.lerobot.layout import FileNumber

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
