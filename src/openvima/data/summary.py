"""Summary of a folder of demonstrations: counts, sizes and histograms."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.data.manifest import CACHE_FOLDER, FAILED_FOLDER, INDEX_NAME, MANIFEST_NAME
from openvima.data.reader import Dataset, data_folder
from openvima.data.schema import COLUMNS, IMAGES
from openvima.data.shard import Shard
from openvima.errors import DatasetError, ShardError, echo
from openvima.hub import dataset_name
from openvima.multiprocess import Report

_NUM_MEASURED = 3  # episodes of each task to measure the size of images on


@dataclass(frozen=True, slots=True)
class Histogram:
    """Counts of values.

    Args:
        title: What is counted, such as "steps in an episode".
        counts: Value, as it is shown, to how often; in the order in which to show them.
    """

    title: str
    counts: dict[str, int]


@dataclass(frozen=True, slots=True)
class TaskSummary:
    """Summary of one task.

    Args:
        task: Its name.
        episodes: Number of episodes.
        steps: Number of steps.
        bytes: Size of their records.
        image_fraction: Fraction of images in these bytes, measured on a few episodes; 0 if none are stored,
            None if no shard was read.
        seeds_tried: Seeds that were tried for them.
        success_rate: Fraction of these seeds that gave an episode.
        redraws: Unlucky draws that the sampler threw away.
    """

    task: str
    episodes: int
    steps: int
    bytes: int
    image_fraction: float | None
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
        num_failed: Episodes in `failed/`; None if there is no such folder.
        object_caches: Name of each object cache to its size in bytes.
    """

    folder: Path
    manifest: dict[str, Any]
    tasks: tuple[TaskSummary, ...]
    histograms: tuple[Histogram, ...]
    num_failed: int | None
    object_caches: dict[str, int]

    @property
    def file_bytes(self) -> int:
        """Size of shards, index and manifest, without failed episodes and object caches."""
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
            "failed_episodes": self.num_failed,
            "object_caches": self.object_caches,
        }
        return {**self.manifest, "summary": summary}


@dataclass(frozen=True, slots=True)
class Unfinished:
    """Summary of a folder whose writing was interrupted.

    Args:
        folder: The folder.
        shards: Number of whole shards.
        episodes: Episodes in them, by task.
        damaged: Names of files that are no shards that can be read.
    """

    folder: Path
    shards: int
    episodes: dict[str, int]
    damaged: tuple[str, ...]

    def to_record(self) -> dict[str, Any]:
        """Return everything as plain values."""
        counts = {"shards": self.shards, "episodes": self.episodes, "damaged": list(self.damaged)}
        return {"summary": {"finished": False, **counts}}


def summarise_folder(
    folder: str | Path, *, details: bool = False, report: Report | None = None
) -> Summary | Unfinished:
    """Summarise a folder.

    Args:
        folder: A data set, finished or not; or one on the Hub such as "hf://owner/name", of which without
            details only manifest and index are fetched.
        details: Also count objects, textures and prompt images, for which every shard is read.
        report: Called with shards read, shards in all, and a note.

    Raises:
        DatasetError: There is no data set, or it is damaged.
        ShardError: A shard is damaged.
        HubError: The Hub has no such data set, or cannot be reached.
    """
    index_only = dataset_name(folder) is not None and not details
    folder = data_folder(folder, shards=not index_only)
    if not (folder / MANIFEST_NAME).is_file() and any(folder.glob("*.arrow")):
        return _summarise_unfinished(folder)
    dataset = Dataset(folder, index_only=index_only)  # which also finds missing files
    task_of = np.array(dataset.index.column("task").to_pylist(), dtype=str)
    histograms = [*_index_histograms(dataset.index)]
    if details:
        histograms += _shard_histograms(dataset, report or (lambda done, total, note: None))
    return Summary(
        folder,
        dataset.manifest,
        tuple(
            _task_summary(dataset, task, task_of == task, index_only=index_only)
            for task in dataset.manifest["tasks"]
        ),
        tuple(histograms),
        _count_failed(folder),
        _measure_caches(folder),
    )


def _summarise_unfinished(folder: Path) -> Unfinished:
    episodes: Counter[str] = Counter()
    damaged = []
    paths = sorted(folder.glob("*.arrow"))
    for path in paths:
        try:
            shard = Shard(path)
        except ShardError:
            damaged.append(path.name)
        else:
            episodes[shard.info.task] += len(shard)
    return Unfinished(folder, len(paths) - len(damaged), dict(sorted(episodes.items())), tuple(damaged))


def _task_summary(dataset: Dataset, task: str, chosen: np.ndarray, *, index_only: bool) -> TaskSummary:
    rows = np.flatnonzero(chosen)
    if not len(rows):
        raise DatasetError(f"{dataset.path} lists the task {echo(task)}, of which it holds no episode.")
    num_bytes = int(dataset.index.column("num_bytes").to_numpy()[rows].sum())
    entry = dataset.manifest["tasks"][task]
    measured = rows[np.linspace(0, len(rows) - 1, min(_NUM_MEASURED, len(rows))).astype(int)]
    counts = {name: entry[name] for name in ("episodes", "steps", "seeds_tried", "success_rate", "redraws")}
    fraction = None if index_only else _image_fraction(dataset, measured.tolist())
    return TaskSummary(task, bytes=num_bytes, image_fraction=fraction, **counts)


def _image_fraction(dataset: Dataset, episodes: Iterable[int]) -> float:
    """Return the fraction of images in the bytes of some records."""
    without = [name for name in COLUMNS.names if name not in IMAGES]
    total = rest = 0
    for episode_index in episodes:
        info = dataset.shard(dataset.locate(episode_index)[0]).info
        if not info.images:
            continue
        batch = dataset.batch(episode_index)
        total += _measure(batch, info.compression)
        rest += _measure(batch.select(without), info.compression)
    return round(1 - rest / total, 4) if total else 0.0


def _measure(batch: pa.RecordBatch, compression: str) -> int:
    """Size of a record as a shard would hold it."""
    sink = pa.MockOutputStream()
    options = pa.ipc.IpcWriteOptions(compression=compression, use_threads=False)
    with pa.ipc.new_stream(sink, batch.schema, options=options) as writer:
        before = sink.size()
        writer.write_batch(batch)
        return sink.size() - before


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


def _count_failed(folder: Path) -> int | None:
    failed = folder / FAILED_FOLDER
    if not failed.is_dir():
        return None
    return sum(len(Shard(path)) for path in failed.glob("*.arrow"))


def _measure_caches(folder: Path) -> dict[str, int]:
    return {
        cache.name: sum(file.stat().st_size for file in cache.rglob("*") if file.is_file())
        for cache in sorted((folder / CACHE_FOLDER).glob("*"))
        if cache.is_dir()
    }
