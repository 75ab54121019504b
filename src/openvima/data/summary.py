"""Summary of a folder of demonstrations: counts, sizes and histograms."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.data.manifest import CACHE_FOLDER, INDEX_NAME, MANIFEST_NAME
from openvima.data.reader import Dataset, data_folder
from openvima.errors import DatasetError, echo
from openvima.hub import dataset_name
from openvima.multiprocess import Report


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts of values.

    Args:
        title: What is counted, such as "steps in an episode".
        counts: Value, as it is shown, to how often; in the order in which to show them.
    """

    title: str
    counts: dict[str, int]

    def rows(self) -> list[tuple[str, int, float, float]]:
        """Return value, count, and its fraction of all and of the largest."""
        total, most = sum(self.counts.values()), max(self.counts.values())
        return [(label, count, count / total, count / most) for label, count in self.counts.items()]


@dataclass(frozen=True, slots=True)
class TaskSummary:
    """Summary of one task.

    Args:
        task: Its name.
        episodes: Number of episodes.
        steps: Number of steps.
        bytes: Size of their records.
        seeds_tried: Seeds that were tried for them.
        success_rate: Fraction of these seeds that gave an episode.
        redraws: Unlucky draws that the sampler threw away.
    """

    task: str
    episodes: int
    steps: int
    bytes: int
    seeds_tried: int
    success_rate: float
    redraws: int


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a finished folder.

    Args:
        folder: The folder.
        manifest: Its manifest.
        tasks: One entry a task, by name.
        histograms: Of levels, steps, tools and, with details, of objects, textures and prompt images.
        object_caches: Name of each object cache to its size in bytes.
    """

    folder: Path
    manifest: dict[str, Any]
    tasks: tuple[TaskSummary, ...]
    histograms: tuple[Histogram, ...]
    object_caches: dict[str, int]

    @property
    def file_bytes(self) -> int:
        """Size of shards, index and manifest, without object caches."""
        shards = sum(entry["bytes"] for entry in self.manifest["shards"].values())
        return shards + sum((self.folder / name).stat().st_size for name in (INDEX_NAME, MANIFEST_NAME))

    def to_record(self) -> dict[str, Any]:
        """Return everything as plain values: the entries of the manifest, and an entry "summary"."""
        tasks = {
            task.task: {name: getattr(task, name) for name in task.__slots__ if name != "task"}
            for task in self.tasks
        }
        summary = {
            "finished": True,
            "file_bytes": self.file_bytes,
            "tasks": tasks,
            "histograms": {histogram.title: histogram.counts for histogram in self.histograms},
            "object_caches": self.object_caches,
        }
        return {**self.manifest, "summary": summary}


def summarise_folder(folder: str | Path, *, details: bool = False, report: Report | None = None) -> Summary:
    """Summarise a folder.

    Args:
        folder: A data set, or one on the Hub such as "hf://owner/name", of which without
            details only manifest and index are fetched.
        details: Also count objects, textures and prompt images, for which every shard is read.
        report: Called with shards read, shards in all, and a note.

    Raises:
        DatasetError: There is no data set, or it is damaged.
        DatasetError: A shard is damaged.
        ServerError: The Hub has no such data set, or cannot be reached.
    """
    index_only = dataset_name(folder) is not None and not details
    folder = data_folder(folder, shards=not index_only)
    dataset = Dataset(folder, index_only=index_only)  # which also finds missing files
    task_of = np.array(dataset.index.column("task").to_pylist(), dtype=str)
    histograms = [*_index_histograms(dataset.index)]
    if details:
        histograms += _shard_histograms(dataset, report or (lambda done, total, note: None))
    return Summary(
        folder,
        dataset.manifest,
        tuple(_task_summary(dataset, task, task_of == task) for task in dataset.manifest["tasks"]),
        tuple(histograms),
        _measure_caches(folder),
    )


def _task_summary(dataset: Dataset, task: str, chosen: np.ndarray) -> TaskSummary:
    rows = np.flatnonzero(chosen)
    if not len(rows):
        raise DatasetError(f"{dataset.path} lists the task {echo(task)}, of which it holds no episode.")
    num_bytes = int(dataset.index.column("num_bytes").to_numpy()[rows].sum())
    entry = dataset.manifest["tasks"][task]
    counts = {name: entry[name] for name in ("episodes", "steps", "seeds_tried", "success_rate", "redraws")}
    return TaskSummary(task, bytes=num_bytes, **counts)


def _index_histograms(index: pa.Table) -> Iterable[Histogram]:
    yield Histogram("level", _in_order(_value_counts(index.column("level"))))
    yield Histogram("steps in an episode", _in_order(_value_counts(index.column("steps"))))
    yield Histogram("end effector", _in_order(_value_counts(index.column("end_effector"))))


def _shard_histograms(dataset: Dataset, report: Report) -> list[Histogram]:
    names = dataset.shard_names()
    numbers = {"objects on the table": Counter[int](), "images in the prompt": Counter[int]()}
    kinds = {
        "objects on the table, by shape": Counter[str](),
        "objects on the table, by texture": Counter[str](),
    }
    for done, name in enumerate(names, start=1):
        table = dataset.shard(name).table(["objects", "prompt_images"])
        objects = table.column("objects").combine_chunks()
        images = table.column("prompt_images").combine_chunks()
        for counter, lists in zip(numbers.values(), (objects, images), strict=True):
            counter.update(_value_counts(lists.value_lengths()))
        for counter, field in zip(kinds.values(), ("object", "texture"), strict=True):
            counter.update(_value_counts(objects.flatten().field(field)))
        report(done, len(names), "")
    return [
        *(Histogram(title, _in_order(counts)) for title, counts in numbers.items()),
        *(Histogram(title, _most_first(counts)) for title, counts in kinds.items()),
    ]


def _in_order(counts: Mapping[Any, int]) -> dict[str, int]:
    return {str(value): counts[value] for value in sorted(counts)}


def _most_first(counts: Counter[str]) -> dict[str, int]:
    return dict(sorted(counts.items(), key=lambda entry: (-entry[1], entry[0])))


def _value_counts(values: pa.Array | pa.ChunkedArray) -> dict[Any, int]:
    return {entry["values"]: entry["counts"] for entry in values.value_counts().to_pylist()}


def _measure_caches(folder: Path) -> dict[str, int]:
    return {
        cache.name: sum(file.stat().st_size for file in cache.rglob("*") if file.is_file())
        for cache in sorted((folder / CACHE_FOLDER).glob("*"))
        if cache.is_dir()
    }
