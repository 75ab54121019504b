"""Checksums of the parts of a shard, so that damage is found before anything is made of its bytes.

A shard is a head (magic bytes and schema), records one after the other, and a tail (the footer that says
where they are). The index holds a CRC-32 of each record, the manifest one of head and tail together: Arrow
then never sees a damaged byte, on which it may fail in odd ways, and a flipped pixel does not go unnoticed.
"""

import itertools
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from openvima.errors import ShardError

MAGIC_BYTES = 8  # "ARROW1" and padding, before the first message


@dataclass(frozen=True, slots=True)
class Span:
    """Where a record lies in its file, and what its bytes add up to.

    Args:
        offset: First byte.
        num_bytes: Length.
        crc32: CRC-32 of its bytes.
    """

    offset: int
    num_bytes: int
    crc32: int

    def fault_in(self, content: memoryview) -> str:
        """Say what is wrong with the record in a file's content; nothing if it is as it was."""
        record = content[self.offset : self.offset + self.num_bytes]
        return "" if zlib.crc32(record) == self.crc32 else "its checksum is wrong"


@dataclass(frozen=True, slots=True)
class Envelope:
    """What lies around the records.

    Args:
        file_bytes: Size of the whole file.
        head_bytes: Bytes before the first record.
        tail_bytes: Bytes after the last one.
        crc32: CRC-32 of head and tail.
    """

    file_bytes: int
    head_bytes: int
    tail_bytes: int
    crc32: int

    def to_entry(self) -> dict[str, int]:
        """Return what the manifest holds of a shard's envelope."""
        return {
            "bytes": self.file_bytes,
            "head_bytes": self.head_bytes,
            "tail_bytes": self.tail_bytes,
            "frame_crc32": self.crc32,
        }

    def fault_in(self, content: memoryview) -> str:
        """Say what is wrong around the records in a file's content; nothing if all is as it was."""
        if len(content) != self.file_bytes:
            return f"it has {len(content):,} of {self.file_bytes:,} bytes"
        is_same = _envelope_crc32(content, self.head_bytes, self.tail_bytes) == self.crc32
        return "" if is_same else "the checksum of its schema and footer is wrong"

    @staticmethod
    def from_entry(entry: Mapping[str, Any]) -> "Envelope":  # Any: numbers and texts
        """Read a shard's entry in the manifest."""
        return Envelope(entry["bytes"], entry["head_bytes"], entry["tail_bytes"], entry["frame_crc32"])


def mapped(path: Path) -> memoryview:
    """Map a file into memory; its bytes are read when they are touched.

    Raises:
        FileNotFoundError: There is no regular file; to open a pipe would block.
    """
    if not path.is_file():
        raise FileNotFoundError(path)
    with pa.memory_map(str(path)) as file:  # the buffer keeps the mapping
        return memoryview(file.read_buffer())


def measure(path: Path) -> tuple[Envelope, list[Span]]:
    """Find the parts of a whole shard and their checksums.

    Raises:
        ShardError: It is no chain of records.
    """
    content = mapped(path)
    try:
        head, *ends = _message_ends(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise ShardError(f"{path}: {str(error).splitlines()[0]}") from None
    spans = [
        Span(start, end - start, zlib.crc32(content[start:end]))
        for start, end in itertools.pairwise([head, *ends])
    ]
    tail = len(content) - (ends[-1] if ends else head)
    return Envelope(len(content), head, tail, _envelope_crc32(content, head, tail)), spans


def spans_of(index: pa.Table) -> list[Span]:
    """Return where the records of a shard lie, from its part of the index."""
    columns = (index.column(name).to_pylist() for name in ("offset", "num_bytes", "crc32"))
    return [Span(*numbers) for numbers in zip(*columns, strict=True)]


def _envelope_crc32(content: memoryview, head_bytes: int, tail_bytes: int) -> int:
    return zlib.crc32(content[len(content) - tail_bytes :], zlib.crc32(content[:head_bytes]))


def _message_ends(path: Path) -> list[int]:
    """Where the schema ends, and each record."""
    ends = []
    with pa.memory_map(str(path)) as file:
        file.seek(MAGIC_BYTES)
        while True:
            try:
                pa.ipc.read_message(file)
            except EOFError:  # the mark after the last record
                break
            ends.append(file.tell())
    if not ends:
        raise pa.ArrowInvalid("it ends before its schema")
    return ends
