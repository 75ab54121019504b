"""Writing shards: under a temporary name until the last byte is on the disk."""

import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import pyarrow as pa

from openvima.data.encoding import ShardInfo, Skipped, encode
from openvima.data.records import Demonstration
from openvima.data.schema import COLUMNS

COMPRESSION_LEVEL = 3  # zstd; higher ones are much slower for a few per cent


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
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        self._schema = COLUMNS.with_metadata(info.to_metadata())
        self._file = open(self._temporary, "wb")  # noqa: SIM115  closed by __exit__
        codec = pa.Codec("zstd", compression_level=COMPRESSION_LEVEL)
        options = pa.ipc.IpcWriteOptions(compression=codec, use_threads=False)
        self._writer = pa.ipc.new_file(self._file, self._schema, options=options)

    def write(self, demo: Demonstration, skipped: Sequence[Skipped] = ()) -> None:
        """Append one episode.

        Args:
            demo: The demonstration.
            skipped: Seeds tried just before it in vain.
        """
        self._writer.write_batch(encode(demo, skipped).replace_schema_metadata(self._schema.metadata))

    def __enter__(self) -> "ShardWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._writer.close()
                self._file.flush()
                os.fsync(self._file.fileno())
                os.replace(self._temporary, self.path)
                _sync_folder(self.path.parent)
        finally:
            self._file.close()
            self._temporary.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is either the old one or the whole new one, whatever happens."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    finally:
        temporary.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Delete what writers that were killed have left in a folder."""
    for pattern in (".*.arrow.*.tmp", ".index.parquet.*.tmp", ".dataset.json.*.tmp"):
        for file in folder.glob(pattern):
            file.unlink(missing_ok=True)


def _sync_folder(folder: Path) -> None:
    """Make a rename last through a power cut, where the system can."""
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
