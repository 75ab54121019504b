"""Manifest, index and file names of a data folder, before its shards are opened."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa

from openvima.data.manifest import (
    FAILED_FOLDER,
    INDEX_NAME,
    MANIFEST_NAME,
    ORIGIN_TYPES,
    index_parts,
    parse_index,
    parse_manifest,
    read_inside,
)
from openvima.data.planning import COMMAND
from openvima.data.reader import why_no_data_set
from openvima.data.shard import remedy
from openvima.data.verification.findings import Problem
from openvima.errors import DatasetError


@dataclass(frozen=True, slots=True, eq=False)
class Inventory:
    """Contents of a data folder.

    Args:
        folder: The folder.
        manifest: Its manifest; None if it cannot be trusted.
        index: Its index; None if it cannot be trusted.
        problems: Problems of both, and of file names.
        notes: Remarks that are no problems.
        doubtful: Origin in a damaged manifest that is still readable.
    """

    folder: Path
    manifest: dict[str, Any] | None  # Any: JSON
    index: pa.Table | None
    problems: tuple[Problem, ...]
    notes: tuple[str, ...]
    doubtful: dict[str, Any] | None = None  # Any: JSON

    @property
    def is_generated(self) -> bool:
        """Whether lost shards can be generated again."""
        return self.manifest is not None and self.manifest["command"] == COMMAND

    @property
    def holds_failed(self) -> bool:
        """Whether it holds the unsolved episodes of a data set."""
        folder = self.folder.resolve()  # which has a name and a parent, even if "." was given
        return folder.name == FAILED_FOLDER and (folder.parent / MANIFEST_NAME).is_file()

    @property
    def remedy(self) -> str:
        """How to repair a file of the folder."""
        return remedy(self.folder.parent if self.holds_failed else self.folder)

    def shard_names(self) -> list[str]:
        """Return the names of the manifest's shards in the order of the data set.

        Without a manifest, they are the names of all shard files.
        """
        if self.manifest is None:
            return sorted(path.name for path in self.folder.glob("*.arrow"))
        listed = self.manifest["shards"]
        first = [] if self.index is None else self.index.column("shard").unique().to_pylist()
        return [name for name in first if name in listed] + sorted(set(listed) - set(first))

    def index_parts(self) -> dict[str, pa.Table]:
        """Return the rows of the index by shard."""
        return {} if self.index is None else index_parts(self.index)


def take_inventory(folder: Path) -> Inventory:
    """Read manifest, index and file names of a folder.

    Args:
        folder: A folder of demonstrations.

    Raises:
        DatasetError: There is no folder, or nothing of a data set in it.
    """
    shards = sorted(path.name for path in folder.glob("*.arrow"))
    if not shards and not (folder / MANIFEST_NAME).is_file():
        raise DatasetError(why_no_data_set(folder))
    problems: list[Problem] = []
    manifest, index = None, None
    found = Inventory(folder, None, None, (), ())
    try:
        manifest = parse_manifest(read_inside(folder / MANIFEST_NAME))
    except FileNotFoundError:
        unfinished = "If the command that wrote it was stopped, repeat it; otherwise"
        problems.append(Problem(MANIFEST_NAME, "it is missing", f"{unfinished} {found.remedy}"))
    except DatasetError as error:
        problems.append(Problem(MANIFEST_NAME, str(error), found.remedy))
    try:
        index_bytes = read_inside(folder / INDEX_NAME)
        index = None if manifest is None else parse_index(index_bytes, manifest)
    except FileNotFoundError:
        problems.append(Problem(INDEX_NAME, "it is missing", found.remedy))
    except DatasetError as error:
        problems.append(Problem(INDEX_NAME, str(error), found.remedy))
    problems += () if manifest is None else _unlisted(shards, manifest)
    doubtful = _doubtful(folder / MANIFEST_NAME) if manifest is None else None
    notes = tuple(_leftovers(folder))
    return replace(
        found, manifest=manifest, index=index, problems=tuple(problems), notes=notes, doubtful=doubtful
    )


def _doubtful(path: Path) -> dict[str, Any] | None:  # Any: JSON
    """Read the origin in a damaged manifest, if it is intact."""
    try:
        manifest = json.loads(read_inside(path))
        origin = {key: manifest[key] for key in ORIGIN_TYPES}
    except (OSError, ValueError, LookupError, TypeError, RecursionError):  # DatasetError is a ValueError
        return None
    is_valid = all(isinstance(origin[key], kind) for key, kind in ORIGIN_TYPES.items())
    return origin if is_valid else None


def _unlisted(shards: list[str], manifest: dict[str, Any]) -> Iterator[Problem]:  # Any: JSON
    remedy = "If a run was stopped, repeat its command; otherwise move the file elsewhere."
    for name in shards:
        if name not in manifest["shards"]:
            yield Problem(name, "the manifest does not list it", remedy)


def _leftovers(folder: Path) -> Iterator[str]:
    for path in sorted(folder.glob(".*.tmp")):
        yield f"{path}: a process was killed while it wrote this, or is writing it. If not, delete it."
