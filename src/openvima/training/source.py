"""The demonstrations of a run before its first step: opened, checked, and split for validation."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from openvima.data.object_cache import ObjectCache
from openvima.data.reader import Dataset, split_hashes
from openvima.data.rerender import UNKNOWN_SCENES
from openvima.errors import ConfigError, DatasetError, unknown_name
from openvima.tasks.registry import list_tasks, task_spec
from openvima.training.batches import BatchOrder, ExampleSource
from openvima.training.config import LoaderConfig
from openvima.training.parallel import Parallel
from openvima.training.run_folder import held_out_demonstrations

_PRIOR_DEMONSTRATIONS = 10_000  # enough for the marginals of 100 bins


def open_demonstrations(
    folder: Path, loader: LoaderConfig | None = None, *, allow_heldout: bool = False
) -> Dataset:
    """Open a folder of demonstrations for training.

    Args:
        folder: The folder.
        loader: Settings that name tasks; demonstrations of `exclude_tasks` are left out. The folder need not
            have the tasks that it names.
        allow_heldout: Accept demonstrations that are held out for evaluation.

    Raises:
        ConfigError: There is no such task, or none is left.
        DatasetError: The folder is no finished data set, or holds demonstrations that are held out.
    """
    loader, dataset = loader or LoaderConfig(), Dataset(folder)
    present = sorted(dataset.manifest["tasks"])
    known, excluded = {*present, *list_tasks()}, loader.excluded_tasks
    named = {"exclude_tasks": excluded, "first_tasks": loader.early_tasks, "repeat_tasks": loader.repeats}
    for setting, tasks in named.items():
        if problems := [
            unknown_name("task", name, known, f"{dataset.path} has {', '.join(present)}.")
            for name in tasks
            if name not in known
        ]:
            raise ConfigError(f"loader.{setting}: {' '.join(problems)}")
    if excluded:
        if not (kept := [task for task in present if task not in excluded]):
            raise ConfigError(
                f"loader.exclude_tasks is {', '.join(excluded)}; {dataset.path} has no other task, only "
                f"{', '.join(present)}."
            )
        dataset = Dataset(folder, tasks=kept)
    if (found := held_out_demonstrations(dataset)) and not allow_heldout:
        raise DatasetError(
            f"{folder} holds demonstrations for evaluation only: {', '.join(found)}. Train on level train, "
            "leave these tasks out, or give --allow-heldout, which is recorded with the policy."
        )
    return dataset


def check_scenes(dataset: Dataset) -> None:
    """Check that the scenes of demonstrations are known, by the first one of each shard.

    Raises:
        DatasetError: They are not, as in imported data.
    """
    for name in dataset.shard_names():
        if not len(dataset.shard(name).read(0, ["poses"])["poses"]):
            raise DatasetError(UNKNOWN_SCENES.format(f"shard {name}"))


def split_examples(cache: ObjectCache, loader: LoaderConfig) -> tuple[ExampleSource, ExampleSource]:
    """Split demonstrations into training and validation.

    The split follows from task and seed, so that it stays the same when data are added.

    Args:
        cache: All demonstrations.
        loader: Which fraction to hold out, and how many at most.

    Raises:
        DatasetError: There is none to train on.
    """
    hashes = split_hashes(cache.dataset.index)
    training = np.flatnonzero(hashes >= loader.validation_fraction)
    kept = np.flatnonzero(hashes < loader.validation_fraction)
    if not len(training):
        raise DatasetError(
            "there is no demonstration to train on; generate some, or lower loader.validation_fraction."
        )
    kept = np.sort(kept[np.argsort(hashes[kept], kind="stable")[: loader.validation_episodes]])
    return _source(cache, training), _source(cache, kept)


def _source(cache: ObjectCache, rows: np.ndarray, first_image: int = 0) -> ExampleSource:
    counts = cache.image_counts()
    return ExampleSource(cache, rows, np.cumsum(counts) - counts + first_image, cache.lengths()[rows])


def repeat_tasks(source: ExampleSource, repeats: Mapping[str, int]) -> ExampleSource:
    """Let an epoch show the demonstrations of some tasks several times."""
    counts = [repeats.get(task, 1) for task in _tasks_of(source)]
    rows, lengths = np.repeat(source.rows, counts), np.repeat(source.lengths, counts, axis=0)
    return replace(source, rows=rows, lengths=lengths)


def find_definers(source: ExampleSource) -> list[int]:
    """Return the demonstrations whose prompts define words, by their index in the cache."""
    defining = [name for name in list_tasks() if "{novel_" in task_spec(name).template]
    return np.unique(source.rows[np.isin(_tasks_of(source), defining)]).tolist()


def _tasks_of(source: ExampleSource) -> np.ndarray:
    return source.cache.dataset.index.column("task").to_numpy(zero_copy_only=False)[source.rows]


def alternative_source(cache: ObjectCache, source: ExampleSource, first_image: int) -> ExampleSource:
    """Return the demonstrations of a source as another cache has them.

    Args:
        cache: Of detected boxes, or of random appearance; it may lack some of them.
        source: The demonstrations.
        first_image: Number of its first image: its images follow those of other caches.
    """
    return _source(cache, source.rows[cache.lengths()[source.rows, 0] > 0], first_image)


def read_actions(source: ExampleSource) -> torch.Tensor:
    """Return the actions of evenly spaced demonstrations, (N, 12), for the prior of an action head."""
    stride = max(1, len(source) // _PRIOR_DEMONSTRATIONS)
    rows = range(0, len(source), stride)
    return torch.from_numpy(np.concatenate([source[row].episode.actions for row in rows]))


def make_order(source: ExampleSource, loader: LoaderConfig, seed: int, parallel: Parallel) -> BatchOrder:
    """Return the order of demonstrations; a batch is at most as large as the data.

    Raises:
        ConfigError: The processes cannot share the demonstrations, or a batch of them, equally.
    """
    num_ranks = parallel.num_ranks
    if len(source) < num_ranks:
        raise ConfigError(
            f"there are {len(source)} demonstrations to train on and {num_ranks} processes; start fewer of "
            "these, or generate more."
        )
    order = BatchOrder(
        len(source),
        batch_size=min(loader.batch_size, len(source) // num_ranks * num_ranks),
        seed=seed,
        lengths=source.lengths if loader.bucket_batches else None,
        bucket=max(1, loader.bucket_batches),
        rank=parallel.rank,
        num_ranks=num_ranks,
    )
    if not loader.first_steps:
        return order
    is_first = np.isin(_tasks_of(source), loader.early_tasks)
    if is_first.all() or not is_first.any():
        return order
    # The first batches show these tasks alone; demonstrations that are repeated are taken once.
    places = np.flatnonzero(is_first)
    places = places[np.unique(source.rows[places], return_index=True)[1]]
    return replace(order, first_batches=loader.first_steps, first_episodes=places)
