"""What lies beside the shards: the index of episodes, and the manifest with counts, checksums and origin."""

import hashlib
import itertools
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from openvima.atomic_io import NO_SPACE, atomic_write_file
from openvima.data.schema import SCHEMA_VERSION
from openvima.data.shard import Shard, Span, measure
from openvima.errors import DatasetError, StorageError

INDEX_NAME = "index.parquet"
MANIFEST_NAME = "dataset.json"
BROKEN_NAME = "broken.json"  # episodes that an import left out
_NAMES = (MANIFEST_NAME, INDEX_NAME, BROKEN_NAME)
CACHE_FOLDER = "object_cache"  # derived from the shards, safe to delete
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
# What a manifest must hold, besides its checksum.
_KEYS = ("command", "config", "versions", "licence", "content_hash", "counts", "tasks", "index", "shards")
_SHARD_NAME = re.compile(r"\w[\w.+-]{0,200}\.arrow")

_NOT_IN_SHARDS = ("shard", "row", "offset", "num_bytes", "crc32")
# What the index and the counts need of each shard.
_COLUMNS = [name for name in INDEX_SCHEMA.names if name not in _NOT_IN_SHARDS] + ["redraws", "skipped"]


@dataclass(frozen=True, slots=True, eq=False)
class ShardSummary:
    """What index and manifest hold of a shard.

    Args:
        name: Of the file.
        entry: Its entry in the manifest: counts, size and checksums.
        index: Its part of the index.
    """

    name: str
    entry: dict[str, Any]
    index: pa.Table


def finish_folder(
    folder: Path,
    shards: Sequence[Path],
    *,
    command: str,
    config: Mapping[str, Any],
    versions: Mapping[str, str],
    licence: str = LICENCE,
) -> None:
    """Write the index and the manifest of a folder whose shards are all there.

    Args:
        folder: The folder.
        shards: All its shards, in the order of the data set.
        command: What made the folder, such as "openvima generate".
        config: The settings that decide the content; nothing that depends on time or machine.
        versions: Package name to version.
        licence: Of the demonstrations.

    Raises:
        DatasetError: A shard is damaged.
    """
    summaries = [summarise_shard(path) for path in shards]
    origin = {"command": command, "config": dict(config), "versions": dict(versions), "licence": licence}
    index, manifest = compose_manifest(summaries, origin)
    sink = BytesIO()
    pq.write_table(index, sink, compression="zstd")
    manifest["index"] = {"bytes": sink.tell(), "sha256": hashlib.sha256(sink.getbuffer()).hexdigest()}
    manifest["checksum"] = manifest_checksum(manifest)
    atomic_write_file(folder / INDEX_NAME, sink.getvalue())
    text = json.dumps(manifest, indent=2, sort_keys=True, ensure_ascii=False)
    atomic_write_file(folder / MANIFEST_NAME, text + "\n")


def split_index(index: pa.Table) -> dict[str, pa.Table]:
    """Return the rows of an index by shard; those of a shard follow each other."""
    shards = index.column("shard").combine_chunks().dictionary_encode()
    starts = np.flatnonzero(np.diff(shards.indices.to_numpy(), prepend=-1)).tolist()
    return {
        shards[start].as_py(): index.slice(start, end - start)
        for start, end in itertools.pairwise([*starts, index.num_rows])
    }


def summarise_shard(path: Path) -> ShardSummary:
    """Read what index and manifest hold of a shard.

    Raises:
        DatasetError: It is damaged.
    """
    table = Shard(path).table(_COLUMNS)
    envelope, spans = measure(path)
    skipped = Counter(entry["kind"] for row in table.column("skipped").to_pylist() for entry in row)
    counts = {
        "episodes": table.num_rows,
        "steps": _sum(table, "steps"),
        "redraws": _sum(table, "redraws"),
        "skipped": dict(sorted(skipped.items())),
    }
    entry = {**counts, **fingerprint(path), **asdict(envelope)}
    return ShardSummary(path.name, entry, _make_index_part(table, path.name, spans))


def compose_manifest(
    summaries: Sequence[ShardSummary], origin: Mapping[str, Any]
) -> tuple[pa.Table, dict[str, Any]]:
    """Put index and manifest together.

    Args:
        summaries: Of all shards, in the order of the data set.
        origin: `command`, `config`, `versions` and `licence`.

    Returns:
        The index, and the manifest without the checksums of the index and of itself.
    """
    index = pa.concat_tables([INDEX_SCHEMA.empty_table(), *(summary.index for summary in summaries)])
    entries: dict[str, list[Mapping[str, Any]]] = {}  # of the shards of each task
    for summary in summaries:
        for task in summary.index.column("task").unique().to_pylist():  # a shard has one
            entries.setdefault(task, []).append(summary.entry)
    manifest = {
        "schema": SCHEMA_VERSION,
        **origin,
        "content_hash": joint_hash(index.column("content_hash").to_pylist()),
        "counts": {
            "episodes": index.num_rows,
            "steps": sum(summary.entry["steps"] for summary in summaries),
            "shards": len(summaries),
            "bytes": sum(summary.entry["bytes"] for summary in summaries),
        },
        "tasks": {task: _add_up(entries[task]) for task in sorted(entries)},
        "shards": {summary.name: summary.entry for summary in summaries},
    }
    return index.combine_chunks(), manifest


def _add_up(entries: Sequence[Mapping[str, Any]]) -> dict[str, object]:
    """Return what the manifest holds of a task: episodes kept, seeds tried, and what became of the others."""
    episodes, steps, redraws = (sum(e[name] for e in entries) for name in ("episodes", "steps", "redraws"))
    skipped = sum((Counter(entry["skipped"]) for entry in entries), Counter[str]())
    num_tried = episodes + skipped.total()
    return {
        "episodes": episodes,
        "steps": steps,
        "seeds_tried": num_tried,
        "success_rate": round(episodes / num_tried, 6),
        "redraws": redraws,
        "skipped": dict(sorted(skipped.items())),
    }


def manifest_checksum(manifest: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a manifest's entries but its own checksum, whatever their order and layout."""
    entries = {key: value for key, value in manifest.items() if key != "checksum"}
    return hashlib.sha256(json.dumps(entries, sort_keys=True).encode()).hexdigest()


def parse_manifest(content: bytes) -> dict[str, Any]:
    """Read a manifest and compare it with its own checksum.

    Raises:
        DatasetError: It is damaged or of another version; the message is the bare cause.
    """
    try:
        manifest = json.loads(content)
        written_as, checksum = manifest["schema"], manifest.get("checksum")
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise DatasetError("it is damaged (no manifest in JSON)") from None
    if written_as != SCHEMA_VERSION:
        raise DatasetError(f"it has schema {written_as}; this package reads {SCHEMA_VERSION}")
    if checksum != manifest_checksum(manifest):
        raise DatasetError("it is damaged or was edited (its checksum is wrong)")
    if lacking := [key for key in _KEYS if key not in manifest]:
        raise DatasetError(f"it lacks {', '.join(lacking)}")
    for name in manifest["shards"]:
        if not _SHARD_NAME.fullmatch(name):  # the object cache has files of these names
            raise DatasetError(f"it names the shard {name!r:.80}, which is no plain file name like a.arrow")
    return manifest


def parse_index(content: bytes, manifest: Mapping[str, Any]) -> pa.Table:
    """Read an index and compare it with its checksum in the manifest.

    Raises:
        DatasetError: It is damaged or has other columns; the message is the bare cause.
    """
    if hashlib.sha256(content).hexdigest() != manifest["index"].get("sha256"):
        raise DatasetError("it is damaged (its checksum is wrong)")
    try:
        # Arrow's I/O threads, which `read_table` starts, can abort the interpreter as it exits.
        index = pq.ParquetFile(pa.BufferReader(content)).read(use_threads=False)
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(f"it is no Parquet file ({error})") from None
    if not index.schema.equals(INDEX_SCHEMA):
        raise DatasetError(f"it has other columns than schema version {SCHEMA_VERSION} asks for")
    return index


def fingerprint(path: Path) -> dict[str, Any]:
    """Return the size and the SHA-256 of a file, as the manifest holds them: `bytes` and `sha256`."""
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return {"bytes": file.tell(), "sha256": digest}


def joint_hash(content_hashes: Iterable[str]) -> str:
    """Return 32 hexadecimal digits that stand for all episodes in their order."""
    return hashlib.sha256("".join(content_hashes).encode()).hexdigest()[:32]


def _make_index_part(table: pa.Table, name: str, spans: Sequence[Span]) -> pa.Table:
    columns = {
        **{column: table.column(column) for column in table.column_names},
        "shard": pa.array([name] * table.num_rows, pa.string()),
        "row": pa.array(range(table.num_rows), pa.int32()),
        "offset": pa.array([span.offset for span in spans], pa.int64()),
        "num_bytes": pa.array([span.num_bytes for span in spans], pa.int32()),
        "crc32": pa.array([span.crc32 for span in spans], pa.uint32()),
    }
    rows = pa.table([columns[column] for column in INDEX_SCHEMA.names], schema=INDEX_SCHEMA)
    return rows.combine_chunks()  # of one row each, which take several kB more


def _sum(table: pa.Table, column: str) -> int:
    return int(table.column(column).to_numpy().sum())


def is_finished(folder: Path) -> bool:
    """Say whether a folder has its manifest and index, which are written last."""
    return (folder / MANIFEST_NAME).is_file() and (folder / INDEX_NAME).is_file()


def clear(folder: Path) -> None:
    """Delete a data set; other files stay."""
    for path in [*(folder / name for name in _NAMES), *folder.glob("*.arrow")]:
        path.unlink(missing_ok=True)


def remove_leftovers(folder: Path, shards: Iterable[Path] | None = None) -> None:
    """Delete what killed writers, perhaps on other machines, left in a folder that is locked.

    Args:
        folder: The data folder.
        shards: The locked shards; None means the whole folder.
    """
    names = None if shards is None else {path.name for path in shards}
    for file in folder.glob(".*.tmp"):  # .NAME.PROCESS.tmp
        name = file.name[1:].rsplit(".", 2)[0]
        if name in names if names is not None else name in _NAMES or name.endswith(".arrow"):
            file.unlink(missing_ok=True)


def storage_error(folder: Path, shards: Sequence[Path], error: OSError) -> StorageError:
    """Return the error to raise where a folder cannot be written to; it says how much of the work is kept.

    Args:
        folder: The data set's folder.
        shards: All its shards, written or not.
        error: What the system said.
    """
    num_there = sum(path.is_file() for path in shards)
    remedy = "Make room" if error.errno in NO_SPACE else "Make sure that it can be written to"
    return StorageError(
        f"cannot write to {folder}: {error.strerror or error}. {num_there} of {len(shards)} shards are "
        f"whole and were kept. {remedy}; the same command then goes on from there."
    )
