"""One data set made of several."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pyarrow as pa

from openvima.atomic_io import atomic_folder, folder_lock
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import finish_folder
from openvima.data.reader import Dataset
from openvima.data.subsets.folders import check_out, joined_licence, joined_versions, provenance
from openvima.data.subsets.shards import CopiedShard, NewShard, ShardNames, write_shards
from openvima.env.config import EnvConfig
from openvima.errors import DatasetError, unknown_name
from openvima.input_files import as_path, names_of, settle
from openvima.tasks.prompts import MULTIMODAL

Duplicates = Literal["refuse", "skip"]
Report = Callable[[int, int, str], None]

_NUM_NAMED = 3  # duplicates that a message names
# What tells two episodes apart, besides the setup of their shard.
_NAME = ("task", "level", "domain", "seed")


@dataclass(frozen=True, slots=True)
class MergeConfig:
    """What to put together, and how.

    Args:
        sources: The data sets; their order does not matter.
        out: The folder to write.
        tasks: Take the episodes of these tasks only; None takes all.
        duplicates: What to do with episodes that several sources hold: "refuse", or "skip" all but one.
        compression: Codec of the new shards, "lz4" or "zstd"; None keeps those of the sources.
        workers: Number of processes.
        force: Replace a data set that is in the folder.
    """

    sources: tuple[Path, ...]
    out: Path
    tasks: tuple[str, ...] | None = None
    duplicates: Duplicates = "refuse"
    compression: str | None = None
    workers: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        settle(self, paths=("out",), names=("tasks",))
        object.__setattr__(self, "sources", tuple(map(as_path, names_of(self.sources))))


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """One shard of a source: the numbers of its episodes in the data set, and how they are named."""

    dataset: Dataset
    name: str
    info: ShardInfo
    episodes: np.ndarray
    order: tuple[object, ...]


def merge(config: MergeConfig, *, report: Report | None = None) -> Path:
    """Put data sets together, of whatever tasks, levels, settings and versions.

    Each shard says what its rows have in common, so it is copied byte for byte under a new number. Only
    where another compression is asked for or episodes are skipped are shards written anew.

    Args:
        config: What to read and write.
        report: Called with episodes written, episodes in all, and a note.

    Returns:
        The folder; its bytes do not depend on the order of the sources or the number of workers.

    Raises:
        DatasetError: A source is no finished data set, an episode occurs more than once, or the folder cannot
            be used.
        ShardError: A source is damaged.
    """
    if not config.sources:
        raise DatasetError("there is nothing to merge; name at least one data set.")
    check_out(config.out, config.sources, force=config.force)
    datasets = sorted(map(Dataset, config.sources), key=lambda dataset: dataset.manifest["checksum"])
    parts = sorted(_parts(datasets, config.tasks), key=lambda part: part.order)
    if not parts:
        raise DatasetError("the sources hold no episodes, so there is nothing to merge.")
    parts = _without_duplicates(parts, skip=config.duplicates == "skip")
    settings = {
        "sources": [provenance(dataset.manifest) for dataset in datasets],
        "tasks": None if config.tasks is None else sorted(config.tasks),
        "duplicates": config.duplicates,
        "compression": config.compression,
    }
    manifests = [dataset.manifest for dataset in datasets]
    with folder_lock(config.out), atomic_folder(config.out) as folder:
        shards = _plan(parts, folder, config.compression)
        write_shards(shards, config.workers, report)
        finish_folder(
            folder,
            [shard.path for shard in shards],
            command="openvima data merge",
            config=settings,
            versions=joined_versions(manifests),
            licence=joined_licence(manifests),
        )
    return config.out


def _parts(datasets: Sequence[Dataset], tasks: Sequence[str] | None) -> list[_Part]:
    if tasks is not None:
        _check_tasks(datasets, tasks)
    return [part for dataset in datasets for part in _parts_of(dataset, tasks)]


def _parts_of(dataset: Dataset, tasks: Sequence[str] | None) -> list[_Part]:
    present = [task for task in dataset.manifest["tasks"] if tasks is None or task in tasks]
    wanted = np.isin(dataset.index.column("task").to_pylist(), present)
    names, shard_of = np.unique(dataset.index.column("shard").to_pylist(), return_inverse=True)
    seeds = dataset.index.column("seed").to_numpy()
    parts = []
    for number, name in enumerate(names.tolist()):
        episodes = np.flatnonzero((shard_of == number) & wanted)
        if not len(episodes):
            continue
        info, entry = dataset.shard(name).info, dataset.manifest["shards"][name]
        # Of duplicates the first is kept: rather one with images than one without.
        order = (
            info.task,
            info.level,
            info.domain,
            int(seeds[episodes[0]]),
            not info.images,
            entry["sha256"],
        )
        parts.append(_Part(dataset, name, info, episodes, order))
    return parts


def _without_duplicates(parts: Sequence[_Part], *, skip: bool) -> list[_Part]:
    """Find episodes that occur more than once; keep the first of each, or refuse.

    Raises:
        DatasetError: There are some, and they are not to be skipped.
    """
    first, names = _first_of_each(parts)
    if not skip and not first.all():
        raise DatasetError(_duplicates_message(parts, first, names))
    bounds = np.cumsum([0, *(len(part.episodes) for part in parts)])
    kept = [
        replace(part, episodes=part.episodes[first[start:end]])
        for part, (start, end) in zip(parts, itertools.pairwise(bounds), strict=True)
    ]
    return [part for part in kept if len(part.episodes)]


def _first_of_each(parts: Sequence[_Part]) -> tuple[np.ndarray, pa.Table]:
    """Whether each episode is the first of its name and setup, shape (N,), bool; and their names.

    Where only the prompts or task options of two setups differ, episodes of equal content count as of one.
    """
    setups: dict[EnvConfig, int] = {}
    tables, numbers, hashes = [], [], []
    for part in parts:
        env_config = part.info.env_config
        setup = setups.setdefault(env_config, len(setups))
        same_content = replace(env_config, prompts=MULTIMODAL, task_options="")
        rows = part.dataset.index.select((*_NAME, "content_hash")).take(part.episodes)
        tables.append(rows.drop_columns("content_hash"))
        numbers.append(np.full(len(rows), setup))
        hashes += [f"{same_content} {content}" for content in rows.column("content_hash").to_pylist()]
    _, firsts_of_content, content = np.unique(hashes, return_index=True, return_inverse=True)
    setup_of_content = np.concatenate(numbers)[firsts_of_content]
    names = pa.concat_tables(tables).append_column("setup", pa.array(setup_of_content[content]))
    numbered = names.append_column("place", pa.array(np.arange(len(names))))
    firsts = numbered.group_by(names.column_names, use_threads=False).aggregate([("place", "min")])
    first = np.zeros(len(names), bool)
    first[firsts.column("place_min").to_numpy()] = True
    return first, names


def _duplicates_message(parts: Sequence[_Part], first: np.ndarray, names: pa.Table) -> str:
    folders = np.repeat([str(part.dataset.path) for part in parts], [len(part.episodes) for part in parts])
    repeated = np.flatnonzero(~first)
    shown = []
    for place in repeated[:_NUM_NAMED]:
        row = names.slice(place, 1).to_pylist()[0]
        same = np.logical_and.reduce([names.column(key).to_numpy() == value for key, value in row.items()])
        where = " and ".join(dict.fromkeys(folders[same].tolist()))
        shown.append("{task} {level} {domain} seed {seed}".format(**row) + f" in {where}")
    more = "; …" if len(repeated) > len(shown) else ""
    return (
        f"{len(repeated)} of {len(names)} episodes repeat others: {'; '.join(shown)}{more}. "
        "Leave a source out, or keep one of each with --duplicates skip."
    )


def _plan(parts: Sequence[_Part], folder: Path, compression: str | None) -> list[NewShard | CopiedShard]:
    names, shards = ShardNames(folder), []
    for part in parts:
        entry, info = part.dataset.manifest["shards"][part.name], part.info
        if len(part.episodes) == entry["episodes"] and compression in (None, info.compression):
            path, _ = names.numbered(info)
            shards.append(
                CopiedShard(path, part.dataset.path / part.name, entry["sha256"], entry["episodes"])
            )
        else:
            info = replace(info, compression=compression or info.compression)
            shards.append(names.new_shard(info, part.dataset, part.episodes.tolist()))
    return shards


def _check_tasks(datasets: Sequence[Dataset], tasks: Sequence[str]) -> None:
    present = sorted({task for dataset in datasets for task in dataset.manifest["tasks"]})
    if not tasks:
        raise DatasetError(f"no task is named; the sources have {', '.join(present)}.")
    for task in tasks:
        if task not in present:
            raise DatasetError(unknown_name("task in the sources called", task, present))
