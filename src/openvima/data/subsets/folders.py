"""Where a data set that is made of others may be written, and what its manifest says of them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from openvima.atomic_io import is_lock_file
from openvima.data.manifest import (
    BROKEN_NAME,
    CACHE_FOLDER,
    FAILED_FOLDER,
    INDEX_NAME,
    MANIFEST_NAME,
    PREVIOUS_NAME,
)
from openvima.errors import DatasetError

_NAMES = (MANIFEST_NAME, PREVIOUS_NAME, INDEX_NAME, BROKEN_NAME, FAILED_FOLDER, CACHE_FOLDER)


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
    if not out.exists() or all(map(is_lock_file, out.iterdir())):
        return
    if not force:
        raise DatasetError(f"{out} is not empty. Give another folder, or --force to replace it.")
    if not _holds_data_sets_only(out):
        raise DatasetError(f"{out} holds other things than data sets, so --force does not replace it.")


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
    """Whether a folder is a data set, or holds some, and nothing besides."""
    entries = [entry for entry in folder.iterdir() if not is_lock_file(entry)]
    if (folder / MANIFEST_NAME).is_file():
        return all(entry.suffix == ".arrow" or entry.name in _NAMES for entry in entries)
    return all((entry / MANIFEST_NAME).is_file() and _holds_data_sets_only(entry) for entry in entries)
