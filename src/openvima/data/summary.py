"""Summary of a folder of demonstrations: counts, sizes and histograms."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from openvima.data.manifest import CACHE_FOLDER, INDEX_NAME, MANIFEST_NAME
from openvima.data.reader import Dataset, data_folder
from openvima.hub import dataset_name
from openvima.multiprocess import Report


@dataclass(frozen=True, slots=True)
class Summary:
    """Summary of a finished folder.

    Args:
        folder: The folder.
        manifest: Its manifest.
        tasks: Name of each task to its entry in the manifest, and "bytes", the size of its records.
        histograms: What is counted, such as "steps in an episode", to how often each value occurs, in the
            order in which to show them: of levels, steps, tools and, with details, of objects, textures and
            prompt images.
        object_caches: Name of each object cache to its size in bytes.
    """

    folder: Path
    manifest: dict[str, Any]
    tasks: dict[str, dict[str, Any]]
    histograms: dict[str, dict[str, int]]
    object_caches: dict[str, int]

    @property
    def file_bytes(self) -> int:
        """Size of shards, index and manifest, without object caches."""
        shards = sum(entry["bytes"] for entry in self.manifest["shards"].values())
        return shards + sum((self.folder / name).stat().st_size for name in (INDEX_NAME, MANIFEST_NAME))

    def to_record(self) -> dict[str, Any]:
        """Return everything as plain values: the entries of the manifest, and an entry "summary"."""
        summary = {
            "finished": True,
            "file_bytes": self.file_bytes,
            "tasks": self.tasks,
            "histograms": self.histograms,
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
    index = dataset.index
    sizes = index.group_by("task").aggregate([("num_bytes", "sum")])
    num_bytes = dict(zip(*(sizes[name].to_pylist() for name in ("task", "num_bytes_sum")), strict=True))
    entries = dataset.manifest["tasks"].items()
    tasks = {task: {**entry, "bytes": num_bytes[task]} for task, entry in entries}
    shown = {"level": "level", "steps in an episode": "steps", "end effector": "end_effector"}
    histograms = {title: _in_order(_value_counts(index.column(name))) for title, name in shown.items()}
    if details:
        histograms |= _shard_histograms(dataset, report or (lambda done, total, note: None))
    return Summary(folder, dataset.manifest, tasks, histograms, _measure_caches(folder))


def _shard_histograms(dataset: Dataset, report: Report) -> dict[str, dict[str, int]]:
    names = dataset.shard_names()
    counts = {
        title: Counter[Any]()
        for title in (
            "objects on the table",
            "images in the prompt",
            "objects on the table, by shape",
            "objects on the table, by texture",
        )
    }
    for done, name in enumerate(names, start=1):
        columns = dataset.shard(name).table(["objects", "prompt_images"]).columns
        objects, images = (column.combine_chunks() for column in columns)
        shown = objects.flatten()
        values = (
            objects.value_lengths(),
            images.value_lengths(),
            shown.field("object"),
            shown.field("texture"),
        )
        for counter, found in zip(counts.values(), values, strict=True):
            counter.update(_value_counts(found))
        report(done, len(names), "")
    histograms = {title: _in_order(counter) for title, counter in counts.items()}
    for title, histogram in histograms.items():
        if ", by " in title:  # frequent ones first
            histograms[title] = dict(sorted(histogram.items(), key=lambda entry: -entry[1]))
    return histograms


def _in_order(counts: Mapping[Any, int]) -> dict[str, int]:
    return {str(value): counts[value] for value in sorted(counts)}


def _value_counts(values: pa.Array | pa.ChunkedArray) -> dict[Any, int]:
    return {entry["values"]: entry["counts"] for entry in values.value_counts().to_pylist()}


def _measure_caches(folder: Path) -> dict[str, int]:
    return {
        cache.name: sum(file.stat().st_size for file in cache.rglob("*") if file.is_file())
        for cache in sorted((folder / CACHE_FOLDER).glob("*"))
        if cache.is_dir()
    }
