"""Converting the published data set to shards, the same bytes whatever the number of workers."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from openvima.atomic_io import NO_SPACE, atomic_write_file, folder_lock
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import BROKEN_NAME, MANIFEST_NAME, finish_folder
from openvima.data.published.episode import ASSETS, DOMAIN, LEVEL, package_versions
from openvima.data.published.reader import (
    Broken,
    EpisodePlace,
    PublishedData,
    Source,
    open_source,
    read_place,
)
from openvima.data.resuming import clear, is_finished, remove_leftovers, storage_error
from openvima.data.shard import Shard
from openvima.data.writer import ShardWriter
from openvima.errors import ConfigError, DatasetError
from openvima.input_files import settle
from openvima.multiprocess import MAX_WORKERS, Counts, imap_with_progress

COMMAND = "openvima data import"
LICENCE = "CC BY 4.0"  # of the published data set
SHARD_SIZE = 1000  # episodes read; broken ones leave their shard smaller
_NUM_PROBES = 3  # episodes of each task

Report = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class ImportConfig:
    """What to import, and where to.

    Args:
        source: The published zip archive, or a folder with unpacked episodes.
        out: The folder to write.
        tasks: Old or new names of tasks; ("all",) means all that are there.
        split: "all", or one of two splits: "train" (twelve thirteenths of each task) or "validation".
        episodes: At most so many of each task, the first ones; None means all.
        shard_size: Episodes in a file.
        compression: Codec of the files, "lz4" or "zstd".
        workers: Number of processes.
        force: Delete a data set that is in the folder.
    """

    source: Path
    out: Path
    tasks: tuple[str, ...] = ("all",)
    split: str = "all"
    episodes: int | None = None
    shard_size: int = SHARD_SIZE
    compression: str = "zstd"
    workers: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        settle(self, paths=("source", "out"), names=("tasks",))
        problems = [
            f"{name} is {value}; it must lie within 1 … {most:,}."
            for name, value, most in (
                ("episodes", self.episodes, 10**7),
                ("shard_size", self.shard_size, 10**6),
                ("workers", self.workers, MAX_WORKERS),
            )
            if value is not None and not 1 <= value <= most
        ]
        if not self.tasks:
            problems.append("tasks is empty; name some, or 'all'.")
        if problems:
            raise ConfigError(" ".join(problems))


@dataclass(frozen=True, slots=True)
class Block:
    """One shard to be written.

    Args:
        path: The file.
        info: What all its rows have in common.
        source: Archive or folder.
        places: The episodes to read.
    """

    path: Path
    info: ShardInfo
    source: Path
    places: tuple[EpisodePlace, ...]


def import_published(config: ImportConfig, report: Report | None = None) -> Path:
    """Convert the published data set, or what a folder still lacks of it.

    Args:
        config: What to import.
        report: Called with episodes read, episodes in all, and a note.

    Returns:
        The folder: shards, `index.parquet`, `dataset.json` and, if any episode is broken, `broken.json` with
        the folder and the fault of each. Its bytes depend on source, settings and versions alone.

    Raises:
        DatasetError: There is nothing to import, nothing that can be read, or the folder holds another data
            set.
        ConfigError: The settings do not fit.
        StorageError: The disk is full. Whole shards are kept.
        FolderLockedError: Another process writes to the folder.
        WorkerError: A worker died. Whole shards are kept, and the same command goes on from there.
    """
    tasks = None if config.tasks == ("all",) else config.tasks
    data = PublishedData(config.source, tasks=tasks, split=config.split)
    blocks = plan(config, data)
    _probe(blocks)
    with folder_lock(config.out):
        _import(config, data, blocks, report)
    return config.out


def _import(
    config: ImportConfig, data: PublishedData, blocks: Sequence[Block], report: Report | None
) -> None:
    if config.force:
        clear(config.out)
    _check_folder(config.out, blocks)
    broken = {block.path: _broken_in(block) for block in blocks}
    missing = [block for block in blocks if broken[block.path] is None]
    try:
        if missing:
            (config.out / MANIFEST_NAME).unlink(missing_ok=True)  # it speaks of whole data sets
        watch = _watch(report, blocks, missing)
        for block, found in imap_with_progress(
            write_block, missing, config.workers, num_counts=2, watch=watch
        ):
            broken[block.path] = found
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise storage_error(config.out, [block.path for block in blocks], error) from error
    finally:
        remove_leftovers(config.out)
    if not is_finished(config.out):
        _finish(config, data, blocks, [entry for block in blocks for entry in broken[block.path] or ()])


def plan(config: ImportConfig, data: PublishedData) -> list[Block]:
    """Divide the episodes into blocks; the division depends on source and settings alone."""
    versions = {**package_versions(), "vima": data.digest()}
    blocks = []
    for task, group in groupby(data.places, key=lambda place: place.key.task):
        places = tuple(group)[: config.episodes]
        for number, start in enumerate(range(0, len(places), config.shard_size)):
            info = ShardInfo(
                task=task,
                level=LEVEL,
                domain=DOMAIN,
                number=number,
                shard_size=config.shard_size,
                first_seed=0,
                assets=ASSETS,
                versions=versions,
                compat=True,
                compression=config.compression,
            )
            chunk = places[start : start + config.shard_size]
            blocks.append(Block(config.out / info.file_name, info, data.path, chunk))
    return blocks


def write_block(block: Block, count: Callable[..., None]) -> list[Broken]:
    """Write one shard.

    Args:
        block: What to write.
        count: Called with the number of episodes read so far, and how many of them were broken.

    Returns:
        The episodes that it lacks because they are broken.
    """
    broken = []
    with ShardWriter(block.path, block.info) as writer:
        for number, found in enumerate(_read(block.source, block.places), start=1):
            if isinstance(found, Broken):
                broken.append(found)
            else:
                writer.write(found)
            count(number, len(broken))
    return broken


def _read(path: Path, places: Sequence[EpisodePlace]) -> Iterator[Any]:  # Any: Demonstration or Broken
    source: Source = open_source(path)
    return (read_place(source, place) for place in places)


def _probe(blocks: Sequence[Block]) -> None:
    """Read a few episodes of each task, so that a source of another form fails at once.

    Raises:
        DatasetError: None of them can be read.
    """
    first = None
    for block in blocks:
        if block.info.number == 0:
            for found in _read(block.source, block.places[:_NUM_PROBES]):
                if not isinstance(found, Broken):
                    return
                first = first or found
    assert first is not None  # there is at least one block
    raise DatasetError(
        f"none of the first episodes in {blocks[0].source} can be read. {first.member}: {first.reason}"
    )


def _broken_in(block: Block) -> list[Broken] | None:
    """The episodes that a finished shard lacks because they are broken; None if it is not finished.

    Raises:
        DatasetError: The shard has episodes that were not asked for.
    """
    if not block.path.is_file():
        return None
    present = set(Shard(block.path).table(["reason"]).column(0).to_pylist())
    others = present - {place.folder for place in block.places}
    if others:
        raise DatasetError(
            f"{block.path} holds episodes that were not asked for, such as {min(others)}. "
            "Give its settings, another folder, or --force to delete it."
        )
    missing = [place for place in block.places if place.folder not in present]
    found = list(_read(block.source, missing))
    return found if all(isinstance(entry, Broken) for entry in found) else None


def _check_folder(folder: Path, blocks: Sequence[Block]) -> None:
    """Refuse a folder with shards that do not belong to this import."""
    wanted = {block.path.name: block for block in blocks}
    for path in sorted(folder.glob("*.arrow")):
        if path.name not in wanted:
            problem = f"it is not among the {len(blocks)} shards that were asked for"
        else:
            found, asked = Shard(path).info, wanted[path.name].info
            names = [name for name in ShardInfo.__slots__ if getattr(found, name) != getattr(asked, name)]
            problem = "; ".join(
                f"{n} is {getattr(found, n)}, asked for is {getattr(asked, n)}" for n in names
            )
        if problem:
            raise DatasetError(
                f"{path} belongs to another data set: {problem}. "
                "Give its settings, another folder, or --force to delete it."
            )


def _finish(config: ImportConfig, data: PublishedData, blocks: Sequence[Block], broken: list[Broken]) -> None:
    info = blocks[0].info  # but for task and number, the same of all
    settings = {
        "tasks": sorted({block.info.task for block in blocks}),
        "split": config.split,
        "level": info.level,
        "domain": info.domain,
        "episodes": config.episodes,
        "shard_size": info.shard_size,
        "compression": info.compression,
        "assets": info.assets,
        "compat": info.compat,
        "source": {
            "digest": info.versions["vima"],
            "episodes": sum(len(block.places) for block in blocks),
            "broken": len(broken),
            "unknown_folders": [entry.member for entry in data.broken_folders],
        },
    }
    (config.out / BROKEN_NAME).unlink(missing_ok=True)
    if broken or data.broken_folders:
        entries = [{"member": b.member, "reason": b.reason} for b in (*data.broken_folders, *broken)]
        text = json.dumps(entries, indent=1, ensure_ascii=False)
        atomic_write_file(config.out / BROKEN_NAME, text + "\n")
    finish_folder(
        config.out,
        [block.path for block in blocks],
        command=COMMAND,
        config=settings,
        versions=info.versions,
        licence=LICENCE,
    )


def _watch(
    report: Report | None, blocks: Sequence[Block], missing: Sequence[Block]
) -> Callable[[Counts], None] | None:
    if report is None:
        return None
    total = sum(len(block.places) for block in blocks)
    before = total - sum(len(block.places) for block in missing)

    def watch(counts: Counts) -> None:
        num_broken = sum(row[1] for row in counts)
        report(before + sum(row[0] for row in counts), total, f"{num_broken} broken" if num_broken else "")

    watch([])
    return watch
