"""Summary of a folder of demonstrations: counts, sizes and histograms."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from openvima.data.manifest import CACHE_FOLDER, INDEX_NAME, MANIFEST_NAME
from openvima.data.reader import Dataset
from openvima.multiprocess import Report


def summarise_folder(
    folder: Path, *, index_only: bool = False, details: bool = False, report: Report | None = None
) -> dict[str, Any]:
    """Summarise a folder.

    Args:
        folder: A data set.
        index_only: There may be no shards, as of a data set on the Hub of which only the index was fetched.
        details: Also count objects, textures and prompt images, for which every shard is read.
        report: Called with shards read, shards in all, and a note.

    Returns:
        The entries of the manifest, and an entry "summary": "finished"; "file_bytes", the size of shards,
        index and manifest; "tasks", name of each task to its entry in the manifest, and "bytes", the size of
        its records; "histograms", what is counted, such as "steps in an episode", to how often each value
        occurs, in the order in which to show them: of levels, steps, tools and, with details, of objects,
        textures and prompt images; and "object_caches", name of each object cache to its size in bytes.

    Raises:
        DatasetError: There is no data set, or it is damaged.
        DatasetError: A shard is damaged.
    """
    dataset = Dataset(folder, index_only=index_only)  # which also finds missing files
    index, manifest = dataset.index, dataset.manifest
    sizes = index.group_by("task").aggregate([("num_bytes", "sum")])
    num_bytes = dict(zip(*(sizes[name].to_pylist() for name in ("task", "num_bytes_sum")), strict=True))
    shown = {"level": "level", "steps in an episode": "steps", "end effector": "end_effector"}
    histograms = {title: _in_order(_value_counts(index.column(name))) for title, name in shown.items()}
    if details:
        histograms |= _shard_histograms(dataset, report or (lambda done, total, note: None))
    beside = sum((folder / name).stat().st_size for name in (INDEX_NAME, MANIFEST_NAME))
    summary = {
        "finished": True,
        "file_bytes": manifest["counts"]["bytes"] + beside,
        "tasks": {task: {**entry, "bytes": num_bytes[task]} for task, entry in manifest["tasks"].items()},
        "histograms": histograms,
        "object_caches": _measure_caches(folder),
    }
    return {**manifest, "summary": summary}


def _shard_histograms(dataset: Dataset, report: Report) -> dict[str, dict[str, int]]:
    num_objects, num_images, shapes, textures = (Counter[Any]() for _ in range(4))
    names = dataset.shard_names()
    for done, name in enumerate(names, start=1):
        columns = dataset.shard(name).table(["objects", "prompt_images"]).columns
        objects, images = (column.combine_chunks() for column in columns)
        num_objects.update(_value_counts(objects.value_lengths()))
        num_images.update(_value_counts(images.value_lengths()))
        shapes.update(_value_counts(objects.flatten().field("object")))
        textures.update(_value_counts(objects.flatten().field("texture")))
        report(done, len(names), "")
    return {
        "objects on the table": _in_order(num_objects),
        "images in the prompt": _in_order(num_images),
        # Frequent ones first.
        "objects on the table, by shape": dict(Counter(_in_order(shapes)).most_common()),
        "objects on the table, by texture": dict(Counter(_in_order(textures)).most_common()),
    }


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
