"""Writing shards: under a temporary name until the last byte is on the disk."""

import contextlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import pyarrow as pa

from openvima.data.encoding import ShardInfo, Skipped, encode
from openvima.data.records import Demonstration
from openvima.data.schema import COLUMNS
from openvima.files import whole_file

COMPRESSION_LEVELS = {"zstd": 3}  # higher ones are much slower for a few per cent


class ShardWriter:
    """Writes one shard; a context manager.

    The file gets its name when the block ends without an exception, so a file with that name is whole. After
    an exception nothing is left; after a crash a hidden temporary file is, which `remove_leftovers` finds.

    Args:
        path: Final name of the shard.
        info: What all its rows have in common.
    """

    def __init__(self, path: Path, info: ShardInfo) -> None:
        self.path = path
        self._info = info
        self._schema = COLUMNS.with_metadata(info.to_metadata())
        codec = pa.Codec(info.compression, compression_level=COMPRESSION_LEVELS.get(info.compression))
        options = pa.ipc.IpcWriteOptions(compression=codec, use_threads=False)
        self._closing = contextlib.ExitStack()
        file = self._closing.enter_context(whole_file(path))
        self._writer = self._closing.enter_context(pa.ipc.new_file(file, self._schema, options=options))

    def write(self, demo: Demonstration, skipped: Sequence[Skipped] = ()) -> None:
        """Append one episode.

        Args:
            demo: The demonstration.
            skipped: Seeds tried just before it in vain.
        """
        self.copy(encode(demo, skipped, with_images=self._info.images))

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


def remove_leftovers(folder: Path) -> None:
    """Delete what writers that were killed have left in a folder."""
    for pattern in (".*.arrow.*.tmp", ".index.parquet.*.tmp", ".dataset.json.*.tmp"):
        for file in folder.glob(pattern):
            file.unlink(missing_ok=True)
