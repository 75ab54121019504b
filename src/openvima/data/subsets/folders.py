"""Where a data set that is made of others may be written, and what its manifest says of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from openvima.data.manifest import MANIFEST_NAME
from openvima.data.reader import Dataset
from openvima.errors import DatasetError, unknown_name


def check_out(out: Path, sources: Sequence[Path], *, force: bool) -> None:
    """Refuse a folder that holds something, or that lies where it would harm a source.

    Args:
        out: The folder to write.
        sources: The data sets to read.
        force: Whether a data set that is there may be replaced.

    Raises:
        DatasetError: Another folder must be given.
    """
    place = out.resolve()
    for source in sources:
        there = source.resolve()
        if place == there or place in there.parents:
            raise DatasetError(f"{out} holds the source {source}, which must stay. Give another folder.")
        if there in place.parents:
            raise DatasetError(f"{out} lies in the source {source}, which must stay as it is. Give another.")
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out} is a file. Give the name of a folder.")
    if not out.exists() or not any(out.iterdir()):
        return
    if not force:
        raise DatasetError(f"{out} is not empty. Give another folder, or --force to replace it.")
    if not _holds_data_sets_only(out):
        raise DatasetError(f"{out} holds other things than data sets, so --force does not replace it.")


def of_tasks(dataset: Dataset, tasks: Sequence[str] | None) -> np.ndarray:
    """Return whether each episode is of one of some tasks, shape (N,), bool; None means all.

    Raises:
        DatasetError: The data set has no episode of a task.
    """
    present = np.array(dataset.index.column("task").to_pylist(), dtype=str)
    if tasks is None:
        return np.ones(len(present), bool)
    for task in tasks:
        if task not in dataset.manifest["tasks"]:
            raise DatasetError(
                unknown_name(f"task in {dataset.path} called", task, dataset.manifest["tasks"])
            )
    return np.isin(present, tasks)


def provenance(manifest: Mapping[str, Any]) -> dict[str, Any]:  # Any: JSON
    """Return what identifies a source, wherever it lies: its content, and the settings that made it."""
    return {key: manifest[key] for key in ("content_hash", "command", "config", "versions")}


def joined_versions(manifests: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the versions of all packages that wrote the sources; several with commas between them."""
    names = sorted({name for manifest in manifests for name in manifest["versions"]})
    return {name: _joined([m["versions"].get(name) for m in manifests], ", ") for name in names}


def joined_licence(manifests: Sequence[Mapping[str, Any]]) -> str:
    """Return the licences of the sources as one SPDX expression."""
    return _joined([manifest["licence"] for manifest in manifests], " AND ")


def _joined(words: Sequence[str | None], between: str) -> str:
    return between.join(sorted({word for word in words if word}))


def _holds_data_sets_only(folder: Path) -> bool:
    if (folder / MANIFEST_NAME).is_file():
        return True
    return all((entry / MANIFEST_NAME).is_file() for entry in folder.iterdir())
