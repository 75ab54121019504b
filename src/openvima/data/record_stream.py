"""Decoding single records without opening their shard.

To open a shard means to parse its schema twice, which takes longer than decoding a record. Where the index
says where a record lies and its checksum is right, its bytes alone will do: all shards have one schema.
"""

import threading
from collections.abc import Sequence

import pyarrow as pa

from openvima.data.schema import COLUMNS

MAX_STREAMS = 64  # sets of columns that a thread keeps a stream for
_SCHEMA_MESSAGE = COLUMNS.serialize()


class RecordStream:
    """A stream of records of any shards, to which other columns do not exist.

    Args:
        columns: Names out of `schema.COLUMNS`.
    """

    def __init__(self, columns: Sequence[str]) -> None:
        fields = [COLUMNS.get_field_index(name) for name in columns]
        options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=fields)
        self._feed = _Feed()
        self._feed.give(memoryview(_SCHEMA_MESSAGE))
        self._reader = pa.ipc.open_stream(pa.PythonFile(self._feed, "r"), options=options)

    def decode(self, record: memoryview) -> pa.RecordBatch:
        """Return a record batch from its bytes; after an error the stream is of no more use.

        Raises:
            ValueError: The bytes are no record (or what else Arrow raises).
        """
        self._feed.give(record)
        try:
            return self._reader.read_next_batch()
        except StopIteration:
            raise ValueError("it is the end of a shard") from None


def decode_record(record: memoryview, columns: Sequence[str]) -> pa.RecordBatch:
    """Return some columns of a record; the batch is validated.

    Args:
        record: Its bytes, of which a checksum was compared.
        columns: Names out of `schema.COLUMNS`.

    Raises:
        ValueError: The bytes are no record of these columns (or what else Arrow raises).
    """
    key = tuple(columns)
    streams = _streams.kept
    stream = streams.pop(key, None) or RecordStream(key)  # taken out: an error leaves none behind
    batch = stream.decode(record)
    batch.validate(full=True)  # 4 µs; offsets that lead out of a buffer would end the process
    if len(streams) >= MAX_STREAMS:
        streams.clear()
    streams[key] = stream
    return batch


class _Feed:
    """A file that holds the bytes it was given last."""

    closed = False

    def give(self, content: memoryview) -> None:
        self._content, self._start = content, 0

    def read_buffer(self, num_bytes: int) -> pa.Buffer:
        start, self._start = self._start, min(self._start + num_bytes, len(self._content))
        return pa.py_buffer(self._content[start : self._start])

    def read(self, num_bytes: int) -> bytes:
        return self.read_buffer(num_bytes).to_pybytes()


class _Streams(threading.local):
    """The streams of a thread, by their columns."""

    def __init__(self) -> None:
        self.kept: dict[tuple[str, ...], RecordStream] = {}


_streams = _Streams()
