"""What lies beside the shards: the index of episodes, and the manifest with counts, checksums and origin.

Also how a folder is filled with shards: which are there already, whose they are, what is missing.
"""

import contextlib
import hashlib
import itertools
import json
import re
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from openvima.atomic_io import FINISH_S, Part, atomic_write_file, folder_lock, parts_in_range
from openvima.data.encoding import ShardInfo
from openvima.data.schema import SCHEMA_VERSION
from openvima.data.shard import SPAN, Shard, measure, remedy
from openvima.errors import DatasetError, StorageError, differences
from openvima.multiprocess import Report

INDEX_NAME = "index.parquet"
MANIFEST_NAME = "dataset.json"
BROKEN_NAME = "broken.json"  # episodes that an import left out
_NAMES = (MANIFEST_NAME, INDEX_NAME, BROKEN_NAME)
CACHE_FOLDER = "object_cache"  # derived from the shards, safe to delete
LICENCE = "MIT"

_INDEX_COLUMNS = {
    "task": pa.string(),
    "level": pa.string(),
    "domain": pa.string(),
    "seed": pa.int64(),
    "steps": pa.int32(),
    "end_effector": pa.string(),
    "shard": pa.string(),
    "row": pa.int32(),
    "content_hash": pa.string(),
    "offset": pa.int64(),  # of the record's first byte in its shard
    "num_bytes": pa.int32(),
    "crc32": pa.uint32(),  # of these bytes
}
INDEX_SCHEMA = pa.schema([pa.field(name, type_, nullable=False) for name, type_ in _INDEX_COLUMNS.items()])
_SHARD_NAME = re.compile(r"\w[\w.+-]{0,200}\.arrow")

# What the index and the counts need of each shard.
_COLUMNS = ("task", "level", "domain", "seed", "steps", "end_effector", "content_hash", "redraws", "skipped")


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
    entries: dict[str, dict[str, Any]] = {}
    of_tasks: dict[str, list[dict[str, Any]]] = {}
    parts = [INDEX_SCHEMA.empty_table()]
    for path in shards:
        entry, part = _summarise_shard(path)
        entries[path.name] = entry
        for task in part.column("task").unique().to_pylist():  # a shard has one
            of_tasks.setdefault(task, []).append(entry)
        parts.append(part)
    index, sink = pa.concat_tables(parts).combine_chunks(), BytesIO()
    pq.write_table(index, sink, compression="zstd")
    manifest = {
        "schema": SCHEMA_VERSION,
        "command": command,
        "config": dict(config),
        "versions": dict(versions),
        "licence": licence,
        "content_hash": joint_hash(index),
        "counts": {
            "episodes": index.num_rows,
            "steps": sum(entry["steps"] for entry in entries.values()),
            "shards": len(entries),
            "bytes": sum(entry["bytes"] for entry in entries.values()),
        },
        "tasks": {task: _add_up(of_tasks[task]) for task in sorted(of_tasks)},
        "shards": entries,
        "index": {"bytes": sink.tell(), "sha256": hashlib.sha256(sink.getbuffer()).hexdigest()},
    }
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


def _summarise_shard(path: Path) -> tuple[dict[str, Any], pa.Table]:
    """Read a shard's entry in the manifest, and its part of the index.

    Raises:
        DatasetError: It is damaged.
    """
    table = Shard(path).table(_COLUMNS)
    frame, spans = measure(path)
    skipped = Counter(entry["kind"] for row in table.column("skipped").to_pylist() for entry in row)
    counts = {
        "episodes": table.num_rows,
        "steps": sum(table.column("steps").to_pylist()),
        "redraws": sum(table.column("redraws").to_pylist()),
        "skipped": dict(sorted(skipped.items())),
    }
    columns = {
        **{name: table.column(name) for name in table.column_names},
        "shard": [path.name] * table.num_rows,
        "row": range(table.num_rows),
        **{name: [span[number] for span in spans] for number, name in enumerate(SPAN)},
    }
    return {**counts, **fingerprint(path), **frame}, pa.table(columns, schema=INDEX_SCHEMA)


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
    for name in manifest["shards"]:
        if not _SHARD_NAME.fullmatch(name):  # the object cache has files of these names
            raise DatasetError(f"it names the shard {name!r:.80}, which is no plain file name like a.arrow")
    return manifest


def parse_index(content: bytes, manifest: Mapping[str, Any]) -> pa.Table:
    """Read an index and compare it with its checksum in the manifest.

    Raises:
        DatasetError: It is damaged; the message is the bare cause.
    """
    if hashlib.sha256(content).hexdigest() != manifest["index"].get("sha256"):
        raise DatasetError("it is damaged (its checksum is wrong)")
    # Arrow's I/O threads, which `read_table` starts, can abort the interpreter as it exits.
    return pq.ParquetFile(pa.BufferReader(content)).read(use_threads=False)


def read_manifest(folder: Path) -> dict[str, Any]:
    """Read the manifest of a data folder.

    Raises:
        DatasetError: There is none, or it is damaged or of another version.
    """
    return _read(folder, MANIFEST_NAME, parse_manifest)


def read_index(folder: Path, manifest: Mapping[str, Any]) -> pa.Table:
    """Read the index of a data folder, as its manifest describes it.

    Raises:
        DatasetError: There is none, or it is damaged.
    """
    return _read(folder, INDEX_NAME, lambda content: parse_index(content, manifest))


def _read(folder: Path, name: str, parse: Callable[[bytes], Any]) -> Any:
    try:
        return parse((folder / name).read_bytes())
    except (FileNotFoundError, NotADirectoryError):
        raise DatasetError(explain_missing(folder, name)) from None
    except DatasetError as error:
        raise DatasetError(f"{folder / name}: {error}. {remedy(folder)}") from None


def explain_missing(folder: Path, name: str = MANIFEST_NAME) -> str:
    """Say what is wrong with a path where a file of a data set is missing, and what helps."""
    if not folder.is_dir():
        return f"there is no folder {folder}; `openvima generate --out {shlex.quote(str(folder))}` makes one."
    inner = sorted(folder.glob(f"*/{MANIFEST_NAME}"))  # as in the folder that `openvima data split` writes
    hint = f", but {inner[0].parent} does" if inner else "; repeat an interrupted `openvima generate`"
    return f"{folder} holds no finished data set ({name} is missing){hint}."


def fingerprint(path: Path) -> dict[str, Any]:
    """Return the size and the SHA-256 of a file, as the manifest holds them: `bytes` and `sha256`."""
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return {"bytes": file.tell(), "sha256": digest}


def joint_hash(index: pa.Table) -> str:
    """Return 32 hexadecimal digits that stand for all episodes of an index in their order."""
    return hashlib.sha256("".join(index.column("content_hash").to_pylist()).encode()).hexdigest()[:32]


def is_finished(folder: Path) -> bool:
    """Say whether a folder has its manifest and index, which are written last."""
    return (folder / MANIFEST_NAME).is_file() and (folder / INDEX_NAME).is_file()


@dataclass(frozen=True, slots=True)
class Block:
    """A shard to be written.

    Args:
        path: The file.
        info: What all its rows have in common.
        episodes: Number of episodes, or the most that it can have.
    """

    path: Path
    info: ShardInfo
    episodes: int


B = TypeVar("B", bound=Block)


def fill_folder(
    folder: Path,
    command: str,
    blocks: Sequence[B],
    *,
    is_done: Callable[[B], bool],
    write: Callable[[Sequence[B], Callable[[int], None]], Iterable[object]],
    settings: Callable[[], Mapping[str, Any]],
    licence: str = LICENCE,
    shard_range: Part | None = None,
    force: bool = False,
    report: Report | None = None,
) -> None:
    """Write those shards of a data set that are not there, and finish it once all are.

    Args:
        folder: The folder.
        command: What makes it; shards of a sample say the same of themselves, with other episodes.
        blocks: All its shards.
        is_done: Whether a shard needs no work.
        write: Writes shards, of which it yields anything, and calls a function with the number of episodes
            done.
        settings: Returns what decides the content, for the manifest; called once all shards are there.
        licence: Of the demonstrations.
        shard_range: First and past-the-end number of the shards to write; None means all of them.
        force: Delete a data set that is in the folder.
        report: Called with episodes done, those that were there included, episodes in all, and "".

    Raises:
        DatasetError: The folder holds a data set of another command, of other settings or versions, or with
            more episodes; a shard is damaged, or not where it should be.
        StorageError: The disk is full, or the folder cannot be written to.
        OSError: It cannot be a folder, as where a file has that name.
        FolderLockedError: Another process writes to the folder, or to the same shards of it.
    """
    own = blocks if shard_range is None else parts_in_range(blocks, shard_range)
    folder.mkdir(parents=True, exist_ok=True)
    with storage_errors(folder, [block.path for block in blocks]):
        with folder_lock(folder, shard_range):
            if force:
                clear(folder)
            _check_shards(folder, command, blocks)
            # Small ones then fill the gaps at the end.
            missing = sorted(itertools.filterfalse(is_done, own), key=lambda block: -block.episodes)
            total, left = (sum(block.episodes for block in part) for part in (own, missing))

            def count(done: int) -> None:
                if report is not None:
                    report(total - left + done, total, "")

            count(0)
            try:
                if missing:
                    (folder / MANIFEST_NAME).unlink(missing_ok=True)  # it speaks of whole data sets
                    for _ in write(missing, count):
                        pass  # a block's result is its file
            finally:  # what killed writers, perhaps on other machines, left of these shards
                for block in own:
                    for file in folder.glob(f".{block.path.name}.*.tmp"):
                        file.unlink(missing_ok=True)
            if lost := [block.path for block in own if not block.path.is_file()]:
                raise DatasetError(
                    f"{lost[0]} was written on another machine and is not to be seen on this one. "
                    "Give an --out that all machines of the cluster share."
                )
        if not is_finished(folder) and all(map(is_done, blocks)):
            with folder_lock(folder, timeout_s=FINISH_S):  # others may have come to the same conclusion
                if not is_finished(folder):
                    finish_folder(
                        folder,
                        [block.path for block in blocks],
                        command=command,
                        config=settings(),
                        versions=blocks[0].info.versions,
                        licence=licence,
                    )


def _check_shards(folder: Path, command: str, blocks: Sequence[Block]) -> None:
    """Refuse a folder whose shards do not belong to the data set that is asked for."""
    if (folder / MANIFEST_NAME).is_file() and (made_by := read_manifest(folder)["command"]) != command:
        raise DatasetError(
            f"{folder} belongs to another data set: `{made_by}` made it. "
            "Give another --out, or --force to delete it."
        )
    wanted = {block.path.name: (block.info, block.episodes) for block in blocks}
    for path in sorted(folder.glob("*.arrow")):
        shard = Shard(path)
        info, num_episodes = wanted.get(path.name, (blocks[0].info, 0))
        problems = differences(shard.info.of_data_set(), info.of_data_set())
        if not problems and len(shard) > num_episodes:
            problems = [f"of its {len(shard)} episodes {num_episodes} are asked for"]
        if problems:
            raise DatasetError(
                f"{path} belongs to another data set, or to a larger one: {'; '.join(problems)}. "
                "Give its settings, another folder, or --force to delete it."
            )


def clear(folder: Path) -> None:
    """Delete a data set; other files stay."""
    for path in [*(folder / name for name in _NAMES), *folder.glob("*.arrow")]:
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def storage_errors(folder: Path, shards: Sequence[Path]) -> Iterator[None]:
    """Let errors of the system say that a folder cannot be written to, and how much of the work is kept.

    Args:
        folder: The data set's folder.
        shards: All its shards, written or not.
    """
    try:
        yield
    except BrokenPipeError:  # of a terminal
        raise
    except OSError as error:
        num_there = sum(path.is_file() for path in shards)
        raise StorageError(
            f"cannot write to {folder}: {error.strerror or error}. {num_there} of {len(shards)} shards are "
            "whole and were kept; the same command goes on from there."
        ) from error
