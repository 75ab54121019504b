"""Subsets of a data set: a sample, or splits of the whole."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openvima.atomic_io import atomic_folder, folder_lock
from openvima.data.manifest import finish_folder
from openvima.data.reader import Dataset, of_tasks
from openvima.data.subsets.choosing import Splits, assign_splits, select_sample
from openvima.data.subsets.folders import check_out, provenance
from openvima.data.subsets.shards import NewShard, plan_shards, write_shards
from openvima.errors import DatasetError
from openvima.input_files import settle

Report = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class SubsetConfig:
    """What to take from where, and how to write it.

    Args:
        source: The data set.
        out: The folder to write.
        tasks: Take the episodes of these tasks only; None takes all.
        seed: Another one gives another choice.
        compression: Codec of the new shards, "lz4" or "zstd"; None keeps that of the source.
        workers: Number of processes.
        force: Replace a data set that is in the folder.
    """

    source: Path
    out: Path
    tasks: tuple[str, ...] | None = None
    seed: int = 0
    compression: str | None = None
    workers: int = 1
    force: bool = False

    def __post_init__(self) -> None:
        settle(self, paths=("source", "out"), names=("tasks",))

    def settings(self, dataset: Dataset) -> dict[str, Any]:  # Any: JSON
        """Return what decides the content, without paths."""
        return {
            "source": provenance(dataset.manifest),
            "tasks": None if self.tasks is None else sorted(self.tasks),
            "seed": self.seed,
            "compression": self.compression,
        }


def sample(config: SubsetConfig, fraction: float, *, report: Report | None = None) -> Path:
    """Sample a data set, with the same fraction of each task.

    Samples of the same data and seed are nested: the 1 % sample is a subset of the 10 % sample. Records are
    copied with their content hashes and their lists of skipped seeds.

    Args:
        config: What to read and write.
        fraction: Above 0, at most 1; of each task round(fraction × episodes), but at least one.
        report: Called with episodes written, episodes in all, and a note.

    Returns:
        The folder; its bytes do not depend on the number of workers.

    Raises:
        DatasetError: The source is no finished data set, or the folder cannot be used.
        ShardError: The source is damaged.
        ConfigError: The fraction is out of range.
    """
    check_out(config.out, [config.source], force=config.force)
    dataset = Dataset(config.source)
    chosen = select_sample(dataset.index, fraction, config.seed) & of_tasks(
        dataset.index, config.tasks, dataset.path
    )
    settings = {**config.settings(dataset), "fraction": fraction}
    with folder_lock(config.out), atomic_folder(config.out) as folder:
        _write([_Subset(folder, chosen, "openvima data sample", settings)], dataset, config, report)
    return config.out


def split(config: SubsetConfig, splits: Splits, *, report: Report | None = None) -> Path:
    """Split a data set: each episode goes to exactly one split.

    Which one follows from the episode and the seed alone, so it stays there when episodes are added. The
    sizes of the splits therefore come close to the fractions without meeting them.

    Args:
        config: What to read and write.
        splits: Names and fractions.
        report: Called with episodes written, episodes in all, and a note.

    Returns:
        The folder, with one data set per split.

    Raises:
        DatasetError: The source is not finished, a split would be empty, or the folder cannot be used.
        ShardError: The source is damaged.
    """
    check_out(config.out, [config.source], force=config.force)
    dataset = Dataset(config.source)
    wanted = of_tasks(dataset.index, config.tasks, dataset.path)
    chosen = {name: mask & wanted for name, mask in assign_splits(dataset.index, splits, config.seed).items()}
    empty = [name for name, mask in chosen.items() if not mask.any()]
    if empty:
        raise DatasetError(
            f"of {wanted.sum()} episodes none would fall into split {', '.join(empty)}. "
            "Give it a larger fraction, or another --seed."
        )
    settings = {**config.settings(dataset), "splits": dict(splits.fractions)}
    with folder_lock(config.out), atomic_folder(config.out) as folder:
        subsets = [
            _Subset(folder / name, mask, "openvima data split", {**settings, "split": name})
            for name, mask in chosen.items()
        ]
        _write(subsets, dataset, config, report)
    return config.out


@dataclass(frozen=True, slots=True, eq=False)
class _Subset:
    """One data set to write: its folder, which episodes it has, and what its manifest says."""

    folder: Path
    mask: np.ndarray
    command: str
    settings: dict[str, Any]  # Any: JSON


def _write(subsets: Sequence[_Subset], dataset: Dataset, config: SubsetConfig, report: Report | None) -> None:
    plans: list[list[NewShard]] = []
    for subset in subsets:
        subset.folder.mkdir(exist_ok=True)
        episodes = np.flatnonzero(subset.mask).tolist()
        plans.append(plan_shards(dataset, episodes, subset.folder, config.compression))
    shards = [shard for plan in plans for shard in plan]
    write_shards(shards, config.workers, report)
    for subset, plan in zip(subsets, plans, strict=True):
        finish_folder(
            subset.folder,
            [shard.path for shard in plan],
            command=subset.command,
            config=subset.settings,
            versions=dataset.manifest["versions"],
            licence=dataset.manifest["licence"],
        )
