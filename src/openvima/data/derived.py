"""Writing a data set that is made of others: where it may lie, its shards, what its manifest says."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from openvima.atomic_io import is_lock_file
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import (
    BROKEN_NAME,
    CACHE_FOLDER,
    FAILED_FOLDER,
    INDEX_NAME,
    MANIFEST_NAME,
)
from openvima.data.reader import Dataset
from openvima.data.shard import ShardWriter
from openvima.errors import DatasetError
from openvima.multiprocess import Report, imap_unordered

_NAMES = (MANIFEST_NAME, INDEX_NAME, BROKEN_NAME, FAILED_FOLDER, CACHE_FOLDER)


def check_out(out: Path, sources: Sequence[Path], *, force: bool) -> None:
    """Refuse a folder that holds something, or that lies where it would harm a source.

    Args:
        out: The folder to write.
        sources: The data sets to read.
        force: Whether a data set that is there may be replaced.

    Raises:
        DatasetError: Another folder must be given.
    """
    place = out.resolve()
    for source in sources:
        there = source.resolve()
        if place == there or place in there.parents:
            raise DatasetError(f"{out} holds the source {source}, which must stay. Give another folder.")
        if there in place.parents:
            raise DatasetError(f"{out} lies in the source {source}, which must stay as it is. Give another.")
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file. Give the name of a folder.")
    if not out.exists() or all(map(is_lock_file, out.iterdir())):
        return
    if not force:
        raise DatasetError(f"{out} is not empty. Give another folder, or --force to replace it.")
    if not _holds_data_sets_only(out):
        raise DatasetError(f"{out} holds other things than data sets, so --force does not replace it.")


def _holds_data_sets_only(folder: Path) -> bool:
    """Whether a folder is a data set, or holds some, and nothing besides."""
    entries = [entry for entry in folder.iterdir() if not is_lock_file(entry)]
    if (folder / MANIFEST_NAME).is_file():
        return all(entry.suffix == ".arrow" or entry.name in _NAMES for entry in entries)
    return all((entry / MANIFEST_NAME).is_file() and _holds_data_sets_only(entry) for entry in entries)


def identify_source(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return what identifies a source, wherever it lies: its content, and the settings that made it."""
    return {key: manifest[key] for key in ("content_hash", "command", "config", "versions")}


@dataclass(frozen=True, slots=True, eq=False)
class ShardPart:
    """Episodes of one data set that become a shard.

    Args:
        info: What all its rows have in common; its number is not used.
        dataset: The data set that holds the rows.
        episodes: Numbers of the rows in the data set, in order.
    """

    info: ShardInfo
    dataset: Dataset
    episodes: Sequence[int]


@dataclass(frozen=True, slots=True)
class ShardCopy:
    """A shard to be written, for a worker.

    Args:
        path: The file.
        info: What all its rows have in common.
        source: Folder of the data set that holds the rows.
        checksum: Of that data set's manifest.
        episodes: As in `ShardPart`.
    """

    path: Path
    info: ShardInfo
    source: Path
    checksum: str
    episodes: tuple[int, ...]


def number_shards(folder: Path, parts: Iterable[ShardPart]) -> list[ShardCopy]:
    """Give shards their files in a folder; those of each task and level are numbered from 0."""
    numbers, shards = Counter[tuple[str, str]](), []
    for part in parts:
        key = part.info.task, part.info.level
        info = replace(part.info, number=numbers[key])
        numbers[key] += 1
        source, checksum = part.dataset.path, part.dataset.manifest["checksum"]
        path, episodes = folder / info.file_name, tuple(part.episodes)
        shards.append(ShardCopy(path, info, source, checksum, episodes))
    return shards


def write_shards(shards: Sequence[ShardCopy], num_workers: int, report: Report | None) -> None:
    """Write shards in several processes.

    Args:
        shards: What to write.
        num_workers: Number of processes.
        report: Called with episodes done, episodes in all, and a note.

    Raises:
        DatasetError: What is read is damaged.
    """
    total = sum(len(shard.episodes) for shard in shards)
    count = None if report is None else (lambda done: report(done, total, ""))
    for _ in imap_unordered(write_shard, shards, num_workers, report=count):
        pass  # a shard's result is its file


def write_shard(shard: ShardCopy, count: Callable[[int], None]) -> None:
    """Write one shard; episodes are read, checked and written one by one.

    Args:
        shard: What to write.
        count: Called with the number of episodes written so far.

    Raises:
        DatasetError: What is read is damaged.
    """
    dataset = _open_unchanged(shard.source, shard.checksum)
    with ShardWriter(shard.path, shard.info) as writer:
        for number, episode_index in enumerate(shard.episodes, start=1):
            writer.copy(dataset.batch(episode_index))
            count(number)


@lru_cache(maxsize=2)
def _open_unchanged(folder: Path, checksum: str) -> Dataset:
    dataset = Dataset(folder)
    if dataset.manifest["checksum"] != checksum:
        raise DatasetError(f"{folder} was changed while it was read. Repeat the command.")
    return dataset
