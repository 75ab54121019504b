"""Writing shards: under a temporary name until the last byte is on the disk."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

import pyarrow as pa

from openvima.atomic_io import atomic_write
from openvima.data.encoding import Encoder, ShardInfo, Skipped
from openvima.data.records import Demonstration
from openvima.data.schema import COLUMNS

COMPRESSION_LEVELS = {"zstd": 3}  # higher ones are much slower for a few percent
BUFFER_BYTES = 1 << 20  # Arrow writes an episode in 150 pieces


class ShardWriter:
    """Writes one shard; a context manager.

    The file gets its name when the block ends without an exception, so a file with that name is whole. After
    an exception nothing is left; after a crash a hidden temporary file is, which the next run deletes.

    Args:
        path: Final name of the shard.
        info: What all its rows have in common.
    """

    def __init__(self, path: Path, info: ShardInfo) -> None:
        self.path = path
        self._schema = COLUMNS.with_metadata(info.to_metadata())
        self._encoder = Encoder(self._schema, with_images=info.images)
        codec = pa.Codec(info.compression, compression_level=COMPRESSION_LEVELS.get(info.compression))
        options = pa.ipc.IpcWriteOptions(compression=codec, use_threads=False)
        self._closing = contextlib.ExitStack()
        sink = _Sink(self._closing.enter_context(atomic_write(path)))
        stream = pa.BufferedOutputStream(pa.PythonFile(sink, "w"), BUFFER_BYTES)
        self._closing.callback(stream.flush)
        self._writer = self._closing.enter_context(pa.ipc.new_file(stream, self._schema, options=options))

    def write(self, demo: Demonstration, skipped: Sequence[Skipped] = ()) -> None:
        """Append one episode.

        Args:
            demo: The demonstration.
            skipped: Seeds tried just before it in vain.
        """
        self._writer.write_batch(self._encoder.encode(demo, skipped))

    def copy(self, batch: pa.RecordBatch) -> None:
        """Append one episode as another shard holds it.

        Args:
            batch: The row, as `Shard.batch` gives it.
        """
        self._writer.write_batch(batch.replace_schema_metadata(self._schema.metadata))

    def __enter__(self) -> "ShardWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._closing.__exit__(kind, error, traceback)


class _Sink:
    """A file that raises only once: what Arrow could not write, it tries again as it ends, and complains."""

    closed = False  # `atomic_write` closes the file

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._has_failed = file, False

    def write(self, data: bytes) -> int:
        if self._has_failed:
            return len(data)
        try:
            return self._file.write(data)
        except BaseException:
            self._has_failed = True
            raise

    def flush(self) -> None:
        """Nothing: `atomic_write` does it."""

    def close(self) -> None:
        """Nothing, likewise."""
