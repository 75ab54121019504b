"""Import of the published demonstrations: where their episodes lie, names of tasks, the conversion."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from openvima.atomic_io import atomic_write_file
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import (
    BROKEN_NAME,
    Block,
    fill_folder,
)
from openvima.data.published_episode import ASSETS, DOMAIN, LEVEL, package_versions, read_demonstration
from openvima.data.published_sources import EpisodeFolders, ZipArchive
from openvima.data.records import Demonstration
from openvima.data.shard import Shard, ShardWriter
from openvima.errors import ConfigError, DatasetError
from openvima.input_files import as_path, names_of, settle
from openvima.multiprocess import Report, check_workers, imap_unordered
from openvima.tasks import list_tasks, task_spec

__all__ = ["Broken", "EpisodeKey", "ImportConfig", "PublishedData", "import_published"]

# Folder names of the published files and of older ones, and what the tasks are called today.
OLD_TASK_NAMES = {
    "simple_manipulation": "visual_manipulation",
    "same_profile": "same_shape",
    "same_color": "same_texture",
    "sweep": "sweep_without_exceeding",
}


def current_task(folder_name: str) -> str | None:
    """Return the name of the task whose episodes a folder holds; None if there is no such task."""
    name = OLD_TASK_NAMES.get(folder_name, folder_name)
    return name if name in list_tasks() else None


class EpisodeKey(NamedTuple):
    """Names one episode.

    Args:
        task: Today's name of the task.
        id: Name of the episode's folder, such as "000123".
    """

    task: str
    id: str


@dataclass(frozen=True, slots=True)
class Broken:
    """An episode, or a folder of them, that cannot be read.

    Args:
        member: Its folder, such as "rotate/000123".
        reason: Why.
    """

    member: str
    reason: str


class EpisodePlace(NamedTuple):
    """Where an episode lies.

    Args:
        folder: Its folder below that of all tasks, such as "same_profile/000123".
        place: For the archive or folder that holds it.
    """

    folder: str
    place: Any


Source = EpisodeFolders | ZipArchive


class PublishedData(Sequence[Demonstration]):
    """The data set that the benchmark's authors published, or one that their generator wrote.

    It is read where it is: nothing is unpacked, and nothing in a file is ever run. Both generations are read,
    also side by side: old and new names of tasks and packages, positions with and without height. Objects can
    be sent to other processes: they open files anew.

    Args:
        path: The zip archive, or a folder with unpacked episodes `…/TASK/ID/`.
        tasks: Keep the episodes of these tasks only; None keeps all.

    Raises:
        DatasetError: There are no episodes, the archive is damaged, or it lacks a task.

    Example:
        >>> data = PublishedData("vima.zip")
        >>> data.keys[0]
        EpisodeKey(task='follow_order', id='000000')
        >>> data.read("follow_order", "000000").prompt.text
        'Stack objects in this order {frame_0} {frame_1} {frame_2}.'
    """

    def __init__(self, path: str | Path, *, tasks: str | Sequence[str] | None = None) -> None:
        self.path = as_path(path)
        self.tasks = None if tasks is None else names_of(tasks)
        self.source = open_source(self.path)
        self.places, self.broken_folders = _sort_places(self.source)
        if self.tasks is not None:
            present = {key.task for key in self.places}
            wanted = {current_task(task) or task_spec(task).name for task in self.tasks}
            if missing := sorted(wanted - present):
                there = ", ".join(sorted(present)) or "none"
                raise DatasetError(f"{self.path} has no episodes of {missing[0]}; it has {there}.")
            self.places = {key: place for key, place in self.places.items() if key.task in wanted}
        if not self.places:
            raise DatasetError(
                f"{self.path} holds no episodes; give vima.zip, or the folder it was unpacked to."
            )
        self.keys = tuple(self.places)  # task and id of all episodes, sorted

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: int) -> Demonstration:  # type: ignore[override]  # no slices
        return self.read(*self.keys[index])

    def read(self, task: str, episode_id: str) -> Demonstration:
        """Read one episode.

        Args:
            task: Old or new name of the task.
            episode_id: Name of its folder, such as "000123".

        Raises:
            DatasetError: There is no such episode.
            DatasetError: It is broken; the message names archive, file and reason.
        """
        key = EpisodeKey(current_task(task) or task, episode_id)
        if key not in self.places:
            raise DatasetError(
                f"{self.path} has no episode {task}/{episode_id}; its ids have gaps, see `keys`."
            )
        found = read_place(self.source, task=key.task, place=self.places[key])
        if isinstance(found, Broken):
            raise DatasetError(f"{self.path}: {found.member}: {found.reason}")
        return found

    def demonstrations(self, on_broken: Callable[[Broken], None] | None = None) -> Iterator[Demonstration]:
        """Read all episodes that are whole.

        Args:
            on_broken: Called with each one that is not.
        """
        for key, place in self.places.items():
            found = read_place(self.source, task=key.task, place=place)
            if isinstance(found, Demonstration):
                yield found
            elif on_broken is not None:
                on_broken(found)

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(PublishedData, tasks=self.tasks), (self.path,)


def open_source(path: Path) -> Source:
    """Open a zip archive or a folder.

    Raises:
        DatasetError: It is neither.
    """
    if path.is_dir():
        return EpisodeFolders(path)
    if not path.is_file():
        raise DatasetError(
            f"there is no file or folder {path}; give vima.zip, or the folder it was unpacked to."
        )
    return ZipArchive(path)


def read_place(source: Source, *, task: str, place: EpisodePlace) -> Demonstration | Broken:
    """Read one episode of a task, or say what is wrong with it.

    Raises:
        DatasetError: The source cannot be read any more.
    """
    try:
        return read_demonstration(source.files(place.place), task=task, folder=place.folder)
    except OSError as error:
        raise DatasetError(f"{source.path} cannot be read: {error.strerror or error}.") from error
    except DatasetError as error:
        return Broken(place.folder, str(error))


def _sort_places(source: Source) -> tuple[dict[EpisodeKey, EpisodePlace], tuple[Broken, ...]]:
    """All episodes of known tasks by task and id, and the folders of others."""
    places: dict[EpisodeKey, tuple[str, EpisodePlace]] = {}
    todays: dict[str, str | None] = {}
    for path, place in source.episodes.items():
        parent, _, episode_id = path.rpartition("/")
        if parent not in todays:
            todays[parent] = current_task(parent.rpartition("/")[2])
        task = todays[parent]
        if task is None:
            continue
        key = EpisodeKey(task, episode_id)
        if key in places:
            raise DatasetError(f"{source.path} holds {task} {episode_id} twice: {places[key][0]} and {path}.")
        folder = f"{parent.rpartition('/')[2]}/{episode_id}"
        places[key] = path, EpisodePlace(folder, place)
    strange = sorted(parent for parent, task in todays.items() if task is None)
    unknown = "there is no task of that name, so its episodes are left out."
    return {key: places[key][1] for key in sorted(places)}, tuple(Broken(each, unknown) for each in strange)


COMMAND = "openvima data import"
LICENCE = "CC BY 4.0"  # of the published data set
SHARD_SIZE = 1000  # episodes read; broken ones leave their shard smaller


@dataclass(frozen=True, slots=True)
class ImportConfig:
    """What to import, and where to.

    Args:
        source: The published zip archive, or a folder with unpacked episodes.
        out: The folder to write.
        tasks: Old or new names of tasks; ("all",) means all that are there.
        episodes: At most so many of each task, the first ones; None means all.
        compression: Codec of the files, "lz4" or "zstd".
        workers: Number of processes.
        force: Delete a data set that is in the folder.
    """

    source: Path
    out: Path
    tasks: tuple[str, ...] = ("all",)
    episodes: int | None = None
    compression: str = "zstd"
    workers: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        settle(self, paths=("source", "out"), names=("tasks",))
        check_workers(self.workers)
        if self.episodes is not None and self.episodes < 1:
            raise ConfigError(f"episodes is {self.episodes}; it must be at least 1.")


@dataclass(frozen=True, slots=True)
class ImportBlock(Block):
    """A shard of the episodes that are not broken.

    Args:
        source: Archive or folder.
        places: The episodes to read.
    """

    source: Path
    places: Sequence[EpisodePlace]


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
    data = PublishedData(config.source, tasks=tasks)
    blocks = plan(config, data)
    fill_folder(
        config.out,
        COMMAND,
        blocks,
        is_done=lambda block: _find_broken(block) is not None,
        write=lambda missing, count: imap_unordered(write_block, missing, config.workers, report=count),
        settings=lambda: _settings(config, data, blocks),
        licence=LICENCE,
        force=config.force,
        report=report,
    )
    return config.out


def plan(config: ImportConfig, data: PublishedData) -> list[ImportBlock]:
    """Divide the episodes into blocks; the division depends on source and settings alone."""
    versions = {**package_versions(), "vima": data.source.digest()}
    blocks = []
    for task, keys in groupby(data.places, key=lambda key: key.task):
        places = [data.places[key] for key in keys][: config.episodes]
        for number, start in enumerate(range(0, len(places), SHARD_SIZE)):
            info = ShardInfo(
                task=task,
                level=LEVEL,
                domain=DOMAIN,
                number=number,
                shard_size=SHARD_SIZE,
                first_seed=0,
                assets=ASSETS,
                versions=versions,
                compat=True,
                compression=config.compression,
            )
            chunk = places[start : start + SHARD_SIZE]
            blocks.append(ImportBlock(config.out / info.file_name, info, len(chunk), data.path, chunk))
    return blocks


def write_block(block: ImportBlock, count: Callable[[int], None]) -> None:
    """Write one shard of the episodes that are not broken.

    Args:
        block: What to write.
        count: Called with the number of episodes read so far.
    """
    source = open_source(block.source)
    with ShardWriter(block.path, block.info) as writer:
        for number, place in enumerate(block.places, start=1):
            found = read_place(source, task=block.info.task, place=place)
            if isinstance(found, Demonstration):
                writer.write(found)
            count(number)


def _find_broken(block: ImportBlock) -> list[Broken] | None:
    """The episodes that a finished shard lacks because they are broken; None if it is not finished."""
    if not block.path.is_file():
        return None
    present = set(Shard(block.path).table(["reason"]).column(0).to_pylist())
    source = open_source(block.source)
    missing = [place for place in block.places if place.folder not in present]
    found = [read_place(source, task=block.info.task, place=place) for place in missing]
    broken = [entry for entry in found if isinstance(entry, Broken)]
    return broken if len(broken) == len(found) else None


def _settings(config: ImportConfig, data: PublishedData, blocks: Sequence[ImportBlock]) -> dict[str, Any]:
    """Return what the manifest holds of settings and source; broken episodes are written to a file."""
    broken = [entry for block in blocks for entry in _find_broken(block) or ()]
    (config.out / BROKEN_NAME).unlink(missing_ok=True)
    if broken or data.broken_folders:
        entries = [asdict(entry) for entry in (*data.broken_folders, *broken)]
        text = json.dumps(entries, indent=1, ensure_ascii=False)
        atomic_write_file(config.out / BROKEN_NAME, text + "\n")
    info = blocks[0].info  # but for task and number, the same of all
    return {
        "tasks": sorted({block.info.task for block in blocks}),
        "episodes": config.episodes,
        "level": info.level,
        "domain": info.domain,
        "shard_size": info.shard_size,
        "compression": info.compression,
        "assets": info.assets,
        "compat": info.compat,
        "source": {
            "digest": info.versions["vima"],
            "episodes": sum(block.episodes for block in blocks),
            "broken": len(broken),
            "unknown_folders": [entry.member for entry in data.broken_folders],
        },
    }
