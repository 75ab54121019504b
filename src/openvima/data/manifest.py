"""What lies beside the shards: the index of episodes, and the manifest with counts, checksums and origin."""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from openvima.data.checksums import Span, measure
from openvima.data.schema import SCHEMA_VERSION
from openvima.files import write_whole

INDEX_NAME = "index.parquet"
MANIFEST_NAME = "dataset.json"
LICENCE = "MIT"

INDEX_SCHEMA = pa.schema(
    [
        pa.field("task", pa.string(), nullable=False),
        pa.field("level", pa.string(), nullable=False),
        pa.field("domain", pa.string(), nullable=False),
        pa.field("seed", pa.int64(), nullable=False),
        pa.field("steps", pa.int32(), nullable=False),
        pa.field("end_effector", pa.string(), nullable=False),
        pa.field("shard", pa.string(), nullable=False),
        pa.field("row", pa.int32(), nullable=False),
        pa.field("content_hash", pa.string(), nullable=False),
        pa.field("offset", pa.int64(), nullable=False),  # of the record's first byte in its shard
        pa.field("num_bytes", pa.int32(), nullable=False),
        pa.field("crc32", pa.uint32(), nullable=False),  # of these bytes
    ]
)
_NOT_IN_SHARDS = ("shard", "row", "offset", "num_bytes", "crc32")
# What the index and the counts need of each shard.
_COLUMNS = [name for name in INDEX_SCHEMA.names if name not in _NOT_IN_SHARDS] + ["redraws", "skipped"]


@dataclass(slots=True)
class _TaskCounts:
    """Episodes kept of a task, seeds tried for them, and what became of the others."""

    episodes: int = 0
    steps: int = 0
    redraws: int = 0
    skipped: Counter = field(default_factory=Counter)

    def record(self) -> dict[str, object]:
        num_tried = self.episodes + self.skipped.total()
        return {
            "episodes": self.episodes,
            "steps": self.steps,
            "seeds_tried": num_tried,
            "success_rate": round(self.episodes / num_tried, 6),
            "redraws": self.redraws,
            "skipped": dict(sorted(self.skipped.items())),
        }


def finish_folder(
    folder: Path,
    shards: Sequence[Path],
    *,
    command: str,
    config: Mapping[str, Any],  # Any: JSON
    versions: Mapping[str, str],
    licence: str = LICENCE,
    report: Callable[[int, int], None] | None = None,
) -> None:
    """Write the index and the manifest of a folder whose shards are all there.

    Args:
        folder: The folder.
        shards: All its shards, in the order of the data set.
        command: What made the folder, such as "openvima generate".
        config: The settings that decide the content; nothing that depends on time or machine.
        versions: Package name to version.
        licence: Of the demonstrations.
        report: Called with shards done and shards in all.

    Raises:
        ShardError: A shard is damaged.
    """
    parts, entries, tasks = [], {}, {}
    for number, path in enumerate(shards):
        table = _read_rows(path)
        frame, spans = measure(path)
        parts.append(_index_part(table, path.name, spans))
        _count(table, tasks)
        counts = {"episodes": table.num_rows, "steps": _sum(table, "steps")}
        entries[path.name] = {**counts, **fingerprint(path), **frame.to_entry()}
        if report is not None:
            report(number + 1, len(shards))
    index = pa.concat_tables(parts) if parts else INDEX_SCHEMA.empty_table()
    sink = BytesIO()
    pq.write_table(index.combine_chunks(), sink, compression="zstd")
    manifest = {
        "schema": SCHEMA_VERSION,
        "command": command,
        "config": dict(config),
        "versions": dict(versions),
        "licence": licence,
        "content_hash": joint_hash(index.column("content_hash")),
        "counts": {
            "episodes": index.num_rows,
            "steps": sum(entry["steps"] for entry in entries.values()),
            "shards": len(entries),
            "bytes": sum(entry["bytes"] for entry in entries.values()),
        },
        "tasks": {task: tasks[task].record() for task in sorted(tasks)},
        "index": {"bytes": sink.tell(), "sha256": hashlib.sha256(sink.getbuffer()).hexdigest()},
        "shards": entries,
    }
    manifest["checksum"] = manifest_checksum(manifest)
    write_whole(folder / INDEX_NAME, sink.getvalue())
    text = json.dumps(manifest, indent=2, sort_keys=True, ensure_ascii=False)
    write_whole(folder / MANIFEST_NAME, text + "\n")


def manifest_checksum(manifest: Mapping[str, Any]) -> str:  # Any: JSON
    """Return the SHA-256 of a manifest's entries but its own checksum, whatever their order and layout."""
    entries = {key: value for key, value in manifest.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()


def fingerprint(path: Path) -> dict[str, Any]:  # Any: a number and a text
    """Return the size and the SHA-256 of a file, as the manifest holds them: `bytes` and `sha256`."""
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return {"bytes": file.tell(), "sha256": digest}


def joint_hash(content_hashes: pa.ChunkedArray) -> str:
    """Return 32 hexadecimal digits that stand for all episodes in their order."""
    digest = hashlib.sha256()
    for chunk in content_hashes.chunks:
        digest.update("".join(chunk.to_pylist()).encode())
    return digest.hexdigest()[:32]


def _read_rows(path: Path) -> pa.Table:
    from openvima.data.reader import Shard  # which reads manifests

    return Shard(path).table(_COLUMNS)


def _index_part(table: pa.Table, name: str, spans: Sequence[Span]) -> pa.Table:
    columns = {
        **{column: table.column(column) for column in table.column_names},
        "shard": pa.array([name] * table.num_rows, pa.string()),
        "row": pa.array(range(table.num_rows), pa.int32()),
        "offset": pa.array([span.offset for span in spans], pa.int64()),
        "num_bytes": pa.array([span.num_bytes for span in spans], pa.int32()),
        "crc32": pa.array([span.crc32 for span in spans], pa.uint32()),
    }
    return pa.table([columns[column] for column in INDEX_SCHEMA.names], schema=INDEX_SCHEMA)


def _count(table: pa.Table, tasks: dict[str, _TaskCounts]) -> None:
    names = np.array(table.column("task").to_pylist())
    for task in sorted(set(names.tolist())):
        rows = table.filter(names == task)
        counts = tasks.setdefault(task, _TaskCounts())
        counts.episodes += rows.num_rows
        counts.steps += _sum(rows, "steps")
        counts.redraws += _sum(rows, "redraws")
        for skipped in rows.column("skipped").to_pylist():
            counts.skipped.update(entry["kind"] for entry in skipped)


def _sum(table: pa.Table, column: str) -> int:
    return int(table.column(column).to_numpy().sum())
