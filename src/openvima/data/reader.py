"""Reading demonstrations: single shards, and whole folders by episode."""

import json
from collections.abc import Iterator, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from openvima.data.encoding import ShardInfo, decode
from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME
from openvima.data.records import Demonstration
from openvima.data.schema import COLUMNS, SCHEMA_VERSION
from openvima.errors import DatasetError, ShardError, unknown_name

_REPAIR = "repeating its `openvima generate` command writes what is missing"


class Shard:
    """One file of demonstrations; rows are read on demand.

    Args:
        path: The file.

    Raises:
        ShardError: It is missing, truncated, or no shard of this package.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._reader = _opened(path)
        try:
            self.info = ShardInfo.from_metadata(self._reader.schema.metadata)
        except ShardError as error:
            raise ShardError(f"{path}: {error}") from None
        if not self._reader.schema.equals(COLUMNS):
            raise ShardError(f"{path} has other columns than schema version {SCHEMA_VERSION} asks for.")

    def __len__(self) -> int:
        return self._reader.num_record_batches

    def __getitem__(self, row: int) -> Demonstration:
        try:
            return decode(self._reader.get_batch(row), self.info)
        except (pa.ArrowInvalid, OSError) as error:
            raise ShardError(_damaged(self.path, f"record {row} of {len(self)}", error)) from None

    def table(self, names: Sequence[str]) -> pa.Table:
        """Read some columns of all rows, without touching the others.

        Args:
            names: Columns of `schema.COLUMNS`.
        """
        reader = _opened(self.path, [COLUMNS.get_field_index(name) for name in names])
        try:
            return reader.read_all().select(list(names))
        except (pa.ArrowInvalid, OSError) as error:
            raise ShardError(_damaged(self.path, "its records", error)) from None


class Dataset:
    """A folder of demonstrations as a sequence; an episode is read when it is asked for.

    Episodes are sorted by task, then by seed. Objects can be sent to other processes: they open files anew.

    Args:
        path: The folder.
        tasks: Keep the episodes of these tasks only; None keeps all.

    Raises:
        DatasetError: The folder is no finished data set, a shard is missing, or it has no such task.
        ShardError: A shard is damaged; raised when it is first read.

    Example:
        >>> dataset = Dataset("demos", tasks=["rotate"])
        >>> dataset[0].prompt.text
        'Rotate the {dragged_obj} 60 degrees.'
    """

    def __init__(self, path: str | Path, *, tasks: Sequence[str] | None = None) -> None:
        self.path = Path(path)
        self.tasks = None if tasks is None else tuple(tasks)
        self.manifest = read_manifest(self.path)
        index = _read_index(self.path)
        if index.num_rows != self.manifest["counts"]["episodes"]:
            raise DatasetError(
                f"{self.path / INDEX_NAME} lists {index.num_rows} episodes, {MANIFEST_NAME} "
                f"{self.manifest['counts']['episodes']}; delete both; {_REPAIR}."
            )
        self.index = index if self.tasks is None else _of_tasks(index, self.tasks, self.path)
        names = self.index.column("shard").combine_chunks().dictionary_encode()
        self._names = names.dictionary.to_pylist()
        self._name_of = names.indices.to_numpy()  # numbers instead of a million texts
        self._rows = self.index.column("row").to_numpy()
        self._shards: dict[str, Shard] = {}
        _check_shards(self.path, sorted(self._names))

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, episode_index: int) -> Demonstration:
        if not -len(self) <= episode_index < len(self):
            raise IndexError(f"episode {episode_index} of {len(self)}; count from 0 to {len(self) - 1}.")
        return self._shard(self._names[self._name_of[episode_index]])[int(self._rows[episode_index])]

    def __iter__(self) -> Iterator[Demonstration]:
        return (self[episode_index] for episode_index in range(len(self)))

    def __reduce__(self) -> tuple[Any, ...]:  # Any: what pickle takes
        return _reopened, (self.path, self.tasks)

    def _shard(self, name: str) -> Shard:
        if name not in self._shards:
            self._shards[name] = Shard(self.path / name)
        return self._shards[name]


def read_manifest(folder: Path) -> dict[str, Any]:  # Any: JSON
    """Read the manifest of a data folder.

    Raises:
        DatasetError: There is none, or it is damaged or of another version.
    """
    path = folder / MANIFEST_NAME
    if not folder.is_dir():
        raise DatasetError(f"there is no folder {folder}; `openvima generate --out {folder}` makes one.")
    if not path.is_file():
        begun = any(folder.glob("*.arrow"))
        fault = "is not finished: repeat its `openvima generate` command" if begun else "holds no data set"
        raise DatasetError(f"{folder} {fault} ({MANIFEST_NAME} is missing).")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        written_as = manifest["schema"]
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError):
        raise DatasetError(f"{path} is damaged; {_REPAIR}.") from None
    if written_as != SCHEMA_VERSION:
        raise DatasetError(f"{path} has schema {written_as}; this package reads {SCHEMA_VERSION}.")
    return manifest


def _reopened(path: Path, tasks: tuple[str, ...] | None) -> Dataset:
    return Dataset(path, tasks=tasks)


def _opened(path: Path, columns: list[int] | None = None) -> pa.RecordBatchFileReader:
    options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=columns)
    try:
        return pa.ipc.open_file(pa.memory_map(str(path)), options=options)
    except FileNotFoundError:
        raise ShardError(f"there is no file {path}; {_REPAIR}.") from None
    except (pa.ArrowInvalid, OSError) as error:
        raise ShardError(_damaged(path, "it", error)) from None


def _damaged(path: Path, what: str, error: Exception) -> str:
    reason = str(error).splitlines()[0]
    return f"{path}: {what} cannot be read, so it is truncated or no shard ({reason}). Delete it; {_REPAIR}."


def _read_index(folder: Path) -> pa.Table:
    path = folder / INDEX_NAME
    try:
        return pq.read_table(BytesIO(path.read_bytes()), use_threads=False)
    except FileNotFoundError:
        raise DatasetError(f"{path} is missing; {_REPAIR}.") from None
    except (pa.ArrowInvalid, OSError):
        raise DatasetError(f"{path} is damaged; {_REPAIR}.") from None


def _of_tasks(index: pa.Table, tasks: Sequence[str], folder: Path) -> pa.Table:
    present = index.column("task").to_pylist()
    for task in tasks:
        if task not in present:
            raise DatasetError(unknown_name(f"task in {folder} called", task, sorted(set(present))))
    return index.take([i for i, task in enumerate(present) if task in tasks])


def _check_shards(folder: Path, names: Sequence[str]) -> None:
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise DatasetError(
            f"{folder} lacks {len(missing)} of {len(names)} shards, first {missing[0]}; {_REPAIR}."
        )
