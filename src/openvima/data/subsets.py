"""Data sets derived from others: sample, split and merge; where they may lie, and how they are written.

Episodes are selected by a hash of their identity, never by their position: the selection is the same for any
order of the episodes, on every machine, and with or without images.
"""

import contextlib
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa

from openvima.atomic_io import atomic_folder, folder_lock, is_lock_file
from openvima.data.encoding import ShardInfo
from openvima.data.generation import LARGEST_SHARD
from openvima.data.manifest import (
    BROKEN_NAME,
    CACHE_FOLDER,
    INDEX_NAME,
    MANIFEST_NAME,
    finish_folder,
    split_index,
)
from openvima.data.reader import Dataset, hash_names, select_tasks
from openvima.data.shard import ShardWriter
from openvima.errors import ConfigError, DatasetError
from openvima.input_files import as_path, names_of, settle
from openvima.multiprocess import Report, imap_unordered
from openvima.tasks.prompts import MULTIMODAL

Duplicates = Literal["refuse", "skip"]

_SPLIT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
_ROUNDING = 1e-6  # tolerance of the sum of fractions
_NAMES = (MANIFEST_NAME, INDEX_NAME, BROKEN_NAME, CACHE_FOLDER)


def _holds_data_sets_only(folder: Path) -> bool:
    """Whether a folder is a data set, or holds some, and nothing besides."""
    entries = [entry for entry in folder.iterdir() if not is_lock_file(entry)]
    if (folder / MANIFEST_NAME).is_file():
        return all(entry.suffix == ".arrow" or entry.name in _NAMES for entry in entries)
    return all((entry / MANIFEST_NAME).is_file() and _holds_data_sets_only(entry) for entry in entries)


@contextlib.contextmanager
def new_folder(
    out: Path,
    sources: Sequence[Path],
    *,
    force: bool,
    is_own: Callable[[Path], bool] = _holds_data_sets_only,
) -> Iterator[Path]:
    """Fill a folder that appears whole, or not at all.

    A folder that holds something is refused, and one that lies where it would harm a source.

    Args:
        out: The folder to write.
        sources: The data sets to read.
        force: Whether what an earlier command wrote there may be replaced.
        is_own: Whether such a command wrote a folder.

    Yields:
        The folder to fill.

    Raises:
        DatasetError: Another folder must be given.
    """
    place = out.resolve()
    for source in sources:
        there = source.resolve()
        if place == there or place in there.parents or there in place.parents:
            raise DatasetError(f"{out} holds the source {source} or lies in it. Give another folder.")
    if out.exists() and not (out.is_dir() and all(map(is_lock_file, out.iterdir()))):
        if not force:
            raise DatasetError(f"{out} is not empty. Give another folder, or --force to replace it.")
        if not (out.is_dir() and is_own(out)):
            raise DatasetError(f"{out} holds other things than --force would write, so it is not replaced.")
    with folder_lock(out), atomic_folder(out) as folder:
        yield folder


def identify_source(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Return what identifies a source, wherever it lies: its content, and the settings that made it."""
    return {key: manifest[key] for key in ("content_hash", "command", "config", "versions")}


def parse_splits(text: str) -> dict[str, float]:
    """Parse splits from the command line: name to fraction.

    Args:
        text: Such as "training=0.923,validation=0.077".

    Raises:
        ConfigError: It is not of that form.
    """
    fractions: dict[str, float] = {}
    for entry in text.split(","):
        name, _, fraction = entry.partition("=")
        try:
            fractions[name.strip()] = float(fraction)
        except ValueError:
            raise ConfigError(
                f"splits are {text!r}; give names and fractions such as training=0.923,validation=0.077."
            ) from None
    return fractions


@dataclass(frozen=True, slots=True)
class SubsetConfig:
    """What to take from where, and how to write it.

    Args:
        source: The data set.
        out: The folder to write.
        tasks: Take the episodes of these tasks only; None takes all.
        seed: Another one gives another choice.
        workers: Number of processes.
        force: Replace a data set that is in the folder.
    """

    source: Path
    out: Path
    tasks: tuple[str, ...] | None = None
    seed: int = 0
    workers: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        settle(self, paths=("source", "out"), names=("tasks",))

    def settings(self, dataset: Dataset) -> dict[str, Any]:
        """Return what decides the content, without paths."""
        return {
            "source": identify_source(dataset.manifest),
            "tasks": None if self.tasks is None else sorted(self.tasks),
            "seed": self.seed,
        }


def sample(
    config: SubsetConfig,
    fraction: float | None = None,
    *,
    episodes: int | None = None,
    report: Report | None = None,
) -> Path:
    """Sample a data set: the same fraction, or the same number of episodes, of each task.

    Samples of the same data and seed are nested: the 1 % sample is a subset of the 10 % sample. Records are
    copied with their content hashes and their lists of skipped seeds.

    Args:
        config: What to read and write.
        fraction: Above 0, at most 1; of each task round(fraction × episodes), but at least one.
        episodes: Instead of a fraction: so many of each task, or all that it has.
        report: Called with episodes written, episodes in all, and a note.

    Returns:
        The folder; its bytes do not depend on the number of workers.

    Raises:
        DatasetError: The source is no finished data set, or the folder cannot be used.
        DatasetError: The source is damaged.
        ConfigError: Neither or both of fraction and number are given, or one is out of range.
    """
    if (fraction is None) == (episodes is None):
        raise ConfigError("give either a fraction or a number of episodes.")
    dataset = Dataset(config.source)
    chosen = select_sample(dataset.index, config.seed, fraction=fraction, episodes=episodes)
    chosen &= select_tasks(dataset.index, config.tasks, str(dataset.path))
    size = {"fraction": fraction} if episodes is None else {"episodes": episodes}
    parts = _group(dataset, chosen)
    sets = {"": (parts, {**config.settings(dataset), **size})}
    return _write(config, [dataset], sets, "openvima data sample", report)


def split(config: SubsetConfig, fractions: Mapping[str, float], *, report: Report | None = None) -> Path:
    """Split a data set: each episode goes to exactly one split.

    Which one follows from the episode and the seed alone, so it stays there when episodes are added. The
    sizes of the splits therefore come close to the fractions without meeting them.

    Args:
        config: What to read and write.
        fractions: Name of each split to its fraction; they add up to 1.
        report: Called with episodes written, episodes in all, and a note.

    Returns:
        The folder, with one data set per split.

    Raises:
        ConfigError: The fractions do not add up to 1, or a name cannot be that of a folder.
        DatasetError: The source is not finished, a split would be empty, or the folder cannot be used.
        DatasetError: The source is damaged.
    """
    are_sound = all(_SPLIT_NAME.fullmatch(name) and 0 < share < 1 for name, share in fractions.items())
    if not are_sound or abs(sum(fractions.values()) - 1) > _ROUNDING:
        given = ", ".join(f"{name}={fraction:g}" for name, fraction in fractions.items())
        raise ConfigError(
            f"splits are {given}; give names of letters, digits, '_' and '-', and fractions between 0 and 1 "
            "that add up to 1."
        )
    dataset = Dataset(config.source)
    wanted = select_tasks(dataset.index, config.tasks, str(dataset.path))
    settings = {**config.settings(dataset), "splits": dict(fractions)}
    sets = {}
    for name, mask in assign_splits(dataset.index, fractions, config.seed).items():
        parts = _group(dataset, mask & wanted)
        if not parts:
            raise DatasetError(
                f"of {wanted.sum()} episodes none would fall into split {name}. "
                "Give it a larger fraction, or another --seed."
            )
        sets[name] = parts, {**settings, "split": name}
    return _write(config, [dataset], sets, "openvima data split", report)


def select_sample(
    index: pa.Table, seed: int, *, fraction: float | None = None, episodes: int | None = None
) -> np.ndarray:
    """Select episodes of each task; samples of the same seed are nested.

    Args:
        index: The episodes.
        seed: Seed of the sample.
        fraction: As in `sample`.
        episodes: As in `sample`.

    Returns:
        Whether each episode is selected, shape (N,), bool.

    Raises:
        ConfigError: The fraction or the number is out of range.
    """
    if fraction is not None and not 0 < fraction <= 1:
        raise ConfigError(f"fraction is {fraction}; it must lie above 0 and not above 1.")
    if episodes is not None and episodes < 1:
        raise ConfigError(f"episodes is {episodes}; it must be at least 1.")
    contents, tasks = (np.array(index.column(name).to_pylist(), str) for name in ("content_hash", "task"))
    # Where hashes tie, as for one seed in two setups, the content decides.
    order = np.lexsort((contents, _hash_episodes(index, "sample", seed)))
    chosen = np.zeros(len(tasks), bool)
    for task in np.unique(tasks):
        of_task = order[tasks[order] == task]
        count = episodes if fraction is None else max(1, round(fraction * len(of_task)))
        chosen[of_task[:count]] = True
    return chosen


def assign_splits(index: pa.Table, fractions: Mapping[str, float], seed: int) -> dict[str, np.ndarray]:
    """Assign each episode to a split.

    The assignment is independent of other episodes: it stays when episodes are added, and sizes match the
    fractions approximately.

    Args:
        index: The episodes.
        fractions: Name of each split to its fraction.
        seed: Seed of the assignment.

    Returns:
        For each split, whether each episode is in it, shape (N,), bool; each episode is in exactly one.
    """
    # Unrelated to the hash of samples; otherwise small samples would all be in the first split.
    places = _hash_episodes(index, "split", seed) / 2.0**64
    *ends, _ = itertools.accumulate(fractions.values())  # the last split has what is left
    numbers = np.searchsorted(ends, places, side="right")
    return {name: numbers == number for number, name in enumerate(fractions)}


def _hash_episodes(index: pa.Table, purpose: str, seed: int) -> np.ndarray:
    """Hash each episode to 64 bits, shape (N,), uint64."""
    columns = [index.column(name).to_pylist() for name in ("task", "level", "domain", "seed")]
    keys = zip(*columns, strict=True)
    return hash_names("\n".join(map(str, (purpose, seed, *key))) for key in keys)


@dataclass(frozen=True, slots=True, eq=False)
class ShardPart:
    """Episodes of one data set that become a shard.

    Args:
        info: What all its rows have in common; it gets its number when it is written.
        source: Folder of the data set that holds the rows.
        checksum: Of that data set's manifest.
        episodes: Numbers of the rows in the data set, in order.
        path: The file, once the shard has a number.
    """

    info: ShardInfo
    source: Path
    checksum: str
    episodes: Sequence[int]
    path: Path = Path()


def _write(
    config: "SubsetConfig | MergeConfig",
    sources: Sequence[Dataset],
    sets: Mapping[str, tuple[Sequence[ShardPart], dict[str, Any]]],
    command: str,
    report: Report | None,
) -> Path:
    """Write data sets into the folder, each by its name there: its parts, and the settings of its manifest.

    Raises:
        DatasetError: The folder cannot be used, or what is read is damaged.
    """
    manifests = [dataset.manifest for dataset in sources]
    packages = sorted({name for manifest in manifests for name in manifest["versions"]})
    with new_folder(config.out, [dataset.path for dataset in sources], force=config.force) as folder:
        shards = {name: _number_shards(folder / name, parts) for name, (parts, _) in sets.items()}
        todo = list(itertools.chain.from_iterable(shards.values()))
        total = sum(len(shard.episodes) for shard in todo)
        count = report and (lambda done: report(done, total, ""))
        for _ in imap_unordered(write_shard, todo, config.workers, report=count):
            pass  # a shard's result is its file
        for name, (_, settings) in sets.items():
            finish_folder(
                folder / name,
                [shard.path for shard in shards[name]],
                command=command,
                config=settings,
                versions={p: _join([m["versions"].get(p) for m in manifests], ", ") for p in packages},
                licence=_join([m["licence"] for m in manifests], " AND "),  # an SPDX expression
            )
    return config.out


def _number_shards(folder: Path, parts: Sequence[ShardPart]) -> list[ShardPart]:
    """Give shards their files in a new folder; those of each task and level are numbered from 0."""
    folder.mkdir(exist_ok=True)
    numbers, shards = Counter[tuple[str, str]](), []
    for part in parts:
        key = part.info.task, part.info.level
        info = replace(part.info, number=numbers[key])
        numbers[key] += 1
        shards.append(replace(part, info=info, path=folder / info.file_name))
    return shards


def write_shard(shard: ShardPart, count: Callable[[int], None]) -> None:
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


def _group(dataset: Dataset, chosen: np.ndarray) -> list[ShardPart]:
    """Divide chosen episodes into shards of equal settings."""
    groups: dict[tuple[str | bytes, ...], tuple[ShardInfo, list[int]]] = {}
    end = 0
    for name, rows in split_index(dataset.index).items():
        start, end = end, end + rows.num_rows
        if chosen[start:end].any():
            common = replace(dataset.shard(name).info, number=0, shard_size=0, first_seed=0)
            key = common.task, common.level, *common.to_metadata().values()
            members = start + np.flatnonzero(chosen[start:end])
            groups.setdefault(key, (common, []))[1].extend(members.tolist())
    return [
        ShardPart(info, dataset.path, dataset.manifest["checksum"], members[start : start + LARGEST_SHARD])
        for _, (info, members) in sorted(groups.items())
        for start in range(0, len(members), LARGEST_SHARD)
    ]


@dataclass(frozen=True, slots=True)
class MergeConfig:
    """What to put together, and how.

    Args:
        sources: The data sets; their order does not matter.
        out: The folder to write.
        tasks: Take the episodes of these tasks only; None takes all.
        duplicates: What to do with episodes that several sources hold: "refuse", or "skip" all but one.
        workers: Number of processes.
        force: Replace a data set that is in the folder.
    """

    sources: tuple[Path, ...]
    out: Path
    tasks: tuple[str, ...] | None = None
    duplicates: Duplicates = "refuse"
    workers: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        settle(self, paths=("out",), names=("tasks",))
        object.__setattr__(self, "sources", tuple(map(as_path, names_of(self.sources))))


def merge(config: MergeConfig, *, report: Report | None = None) -> Path:
    """Put data sets together, of whatever tasks, levels, settings and versions.

    Args:
        config: What to read and write.
        report: Called with episodes written, episodes in all, and a note.

    Returns:
        The folder; its bytes do not depend on the order of the sources or the number of workers.

    Raises:
        DatasetError: A source is no finished data set, an episode occurs more than once, or the folder cannot
            be used.
        DatasetError: A source is damaged.
    """
    datasets = sorted(map(Dataset, config.sources), key=lambda dataset: dataset.manifest["checksum"])
    index = pa.concat_tables([dataset.index for dataset in datasets])
    wanted = select_tasks(index, config.tasks, "the sources")
    masks = np.split(wanted, np.cumsum([len(dataset) for dataset in datasets])[:-1])
    parts = [part for dataset, mask in zip(datasets, masks, strict=True) for part in _group(dataset, mask)]
    # Of duplicates the first is kept: rather one with images than one without.
    parts.sort(key=lambda part: (part.info.task, part.info.level, part.info.domain, not part.info.images))
    indices = {dataset.path: dataset.index for dataset in datasets}
    parts = _skip_duplicates(parts, indices, refuse=config.duplicates == "refuse")
    settings = {
        "sources": [identify_source(dataset.manifest) for dataset in datasets],
        "tasks": None if config.tasks is None else sorted(config.tasks),
        "duplicates": config.duplicates,
    }
    return _write(config, datasets, {"": (parts, settings)}, "openvima data merge", report)


def _skip_duplicates(
    parts: Sequence[ShardPart], indices: Mapping[Path, pa.Table], *, refuse: bool
) -> list[ShardPart]:
    """Keep the first of all episodes of one name and setup; `indices` are those of the sources.

    Where only the prompts or task options of two setups differ, episodes of equal content count as of one.

    Raises:
        DatasetError: Some occur more than once, and they are refused.
    """
    folders: dict[tuple[Any, ...], Path] = {}  # name and setup, and content, to where it was first
    kept, repeats = [], []
    for part in parts:
        setup = part.info.env_config
        common = replace(setup, prompts=MULTIMODAL, task_options="")
        names = ("task", "level", "domain", "seed", "content_hash")
        rows = indices[part.source].select(names).take(part.episodes).to_pylist()
        episodes = []
        for episode_index, row in zip(part.episodes, rows, strict=True):
            content = common, row.pop("content_hash")
            keys = content, (*row.values(), setup)
            first = [folders[key] for key in keys if key in folders]
            for key in keys:
                folders.setdefault(key, part.source)
            if first:
                named = "{task} {level} {domain} seed {seed}".format(**row)
                repeats.append(f"{named} in {first[0]} and {part.source}")
            else:
                episodes.append(episode_index)
        if episodes:
            kept.append(replace(part, episodes=episodes))
    if repeats and refuse:
        raise DatasetError(
            f"{len(repeats)} episodes repeat others, such as {repeats[0]}. "
            "Leave a source out, or keep one of each with --duplicates skip."
        )
    return kept


def _join(words: Sequence[str | None], between: str) -> str:
    return between.join(sorted({word for word in words if word}))
