"""Rewriting a damaged shard with its whole records, wherever they are in the file."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa

from openvima.data.checksums import MAGIC_BYTES, Span, mapped
from openvima.data.decoding import decode
from openvima.data.encoding import ShardInfo
from openvima.data.rerender import rerendered
from openvima.data.schema import COLUMNS
from openvima.data.shard import ODD_ERRORS, Shard
from openvima.data.writer import ShardWriter
from openvima.errors import OpenVimaError, ShardError

_MARK = 0xFFFFFFFF  # begins every message of an Arrow file, at a multiple of 8 bytes


def rewrite(path: Path, spans: list[Span] | None) -> set[str]:
    """Rewrite a shard with those of its records that are whole; without any it is deleted.

    Args:
        path: The shard; it may be missing.
        spans: Its records in the index; without, records are compared with their content hashes.

    Returns:
        Content hashes of the records that were kept.

    Raises:
        ShardError: There are whole records, but schema and footer are damaged; or there is neither an index
            nor an image, and the images that belong to the content hashes cannot be rendered.
    """
    if not path.is_file():
        return set()
    content = mapped(path) if path.stat().st_size else memoryview(b"")
    info = _info(path, content)
    try:
        batches = list(_whole_records(content, info, spans))
    except ShardError as error:
        raise ShardError(f"{path}: {error}") from error
    if not batches:
        path.unlink()
    elif info is None:
        raise ShardError(
            f"{path} has {len(batches)} whole records, but its schema and its footer are damaged. "
            "Restore it from a copy, or delete it to go on without."
        )
    else:
        with ShardWriter(path, info) as writer:
            for batch in batches:
                writer.copy(batch)
    return {batch.column("content_hash")[0].as_py() for batch in batches}


def _info(path: Path, content: memoryview) -> ShardInfo | None:
    """Read the metadata of a shard from its footer, or else from its head."""
    try:
        return Shard(path).info
    except ShardError:
        pass
    try:
        schema = pa.ipc.read_schema(pa.BufferReader(content[MAGIC_BYTES:]))
        return ShardInfo.from_metadata(schema.metadata)
    except ODD_ERRORS:
        return None


def _whole_records(
    content: memoryview, info: ShardInfo | None, spans: list[Span] | None
) -> Iterator[pa.RecordBatch]:
    """Yield whole records in the order of the file; each is found by its mark."""
    known = None if spans is None else {(span.num_bytes, span.crc32) for span in spans}
    words = np.frombuffer(content[: len(content) // 8 * 8], dtype="<u4")[::2]
    end = 0
    for position in (np.flatnonzero(words == _MARK) * 8).tolist():
        if position < end:  # inside the record before
            continue
        try:
            source = pa.BufferReader(pa.py_buffer(content[position:]))
            message = pa.ipc.read_message(source)
            num_bytes = source.tell()
            found = (num_bytes, zlib.crc32(content[position : position + num_bytes]))
            if known is not None and found not in known:
                continue
            batch = pa.ipc.read_record_batch(message, COLUMNS)
            batch.validate(full=True)
            if known is None and not _has_own_hash(batch, info):
                continue
        except ShardError:
            raise
        except (EOFError, *ODD_ERRORS):
            continue
        end = position + num_bytes
        yield batch


def _has_own_hash(batch: pa.RecordBatch, info: ShardInfo | None) -> bool:
    """Whether a record is as it was written, as far as that can be known.

    Raises:
        ShardError: The record has no images, and they cannot be rendered as they were.
    """
    if batch.num_rows != 1:
        return False
    if info is None:
        return True  # `rewrite` refuses the shard: a record that cannot be compared is not deleted
    stored = batch.column("content_hash")[0].as_py()
    try:
        demo = decode(batch, info)
        if info.images:
            return demo.content_hash() == stored
    except OpenVimaError:
        return False
    try:
        return rerendered(demo, info, stored).content_hash() == stored
    except OpenVimaError as error:  # which may lie with the renderer or the assets, not with the record
        raise ShardError(
            f"without an index, its records cannot be compared: {error} Restore index.parquet from a copy, "
            "or repair with the versions and assets that wrote the records; none was deleted."
        ) from error
