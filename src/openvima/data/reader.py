"""Reading a folder of demonstrations as a sequence of episodes."""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.data.checksums import Envelope, Span
from openvima.data.hub import data_folder
from openvima.data.manifest import (
    INDEX_NAME,
    MANIFEST_NAME,
    is_inside,
    parse_index,
    parse_manifest,
    read_inside,
)
from openvima.data.records import Demonstration, Step
from openvima.data.schema import VIEWS
from openvima.data.shard import Shard, remedy
from openvima.errors import MAX_CHARACTERS, DatasetError, cut, unknown_name
from openvima.html import notebook_html
from openvima.input_files import names_of


class Dataset:
    """A folder of demonstrations as a sequence; an episode is read when it is asked for.

    Episodes come in the order in which they are stored. Objects can be sent to other processes: they open
    files anew.

    Args:
        path: The folder, or a data set on the Hugging Face Hub such as "hf://owner/name@revision", which is
            downloaded.
        tasks: Keep the episodes of these tasks only; None keeps all.
        index_only: Read manifest and index only, which of a data set on the Hub are then all that is fetched.

    Raises:
        DatasetError: The folder is no finished data set, a shard is missing, or it has no such task.
        ShardError: A shard is damaged; raised when it is first read.
        HubError: The Hub has no such data set, or cannot be reached.

    Example:
        >>> dataset = Dataset("demos", tasks=["rotate"])
        >>> dataset[0].prompt.text
        'Rotate the {dragged_obj} 60 degrees.'
    """

    def __init__(
        self, path: str | Path, *, tasks: str | Sequence[str] | None = None, index_only: bool = False
    ) -> None:
        self.path = data_folder(path, shards=not index_only)
        self.tasks = None if tasks is None else names_of(tasks)
        self.manifest = read_manifest(self.path)
        index = _read_index(self.path, self.manifest)
        self.index = index.filter(of_tasks(index, self.tasks, self.path)) if self.tasks is not None else index
        names = self.index.column("shard").combine_chunks().dictionary_encode()
        self._names = names.dictionary.to_pylist()
        self._name_of = names.indices.to_numpy()  # numbers instead of a million texts
        self._rows = self.index.column("row").to_numpy()
        self._spans = [self.index.column(name).to_numpy() for name in ("offset", "num_bytes", "crc32")]
        self._shards: dict[str, Shard] = {}
        if not index_only:
            _check_shards(self.path, sorted(self._names))

    def __repr__(self) -> str:
        tasks = ", ".join(self.tasks or self.manifest["tasks"])
        return cut(f"Dataset({str(self.path)!r}, {len(self):,} demonstrations: {tasks})", MAX_CHARACTERS)

    def _repr_html_(self) -> str | None:
        found = self.index.group_by("task").aggregate([([], "count_all"), ("steps", "sum")]).to_pylist()
        counts = {entry["task"]: (entry["count_all"], entry["steps_sum"]) for entry in found}
        return notebook_html("dataset", dataset=self, counts=dict(sorted(counts.items())))

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, episode_index: int) -> Demonstration:
        shard, row = self._checked(episode_index)
        return shard[row]

    def __iter__(self) -> Iterator[Demonstration]:
        return (self[episode_index] for episode_index in range(len(self)))

    def read(self, episode_index: int, columns: Sequence[str]) -> dict[str, Any]:  # Any: one column, one type
        """Read some columns of one episode, as `Shard.read` does.

        Example:
            >>> Dataset("demos").read(0, ["rgb_top", "pose0_position"])["rgb_top"].shape
            (2, 128, 256, 3)
        """
        shard, row = self._checked(episode_index)
        return shard.read(row, columns)

    def step(self, episode_index: int, step: int, *, views: Sequence[str] = VIEWS, segm: bool = True) -> Step:
        """Read one step of one episode, as `Shard.step` does."""
        shard, row = self._checked(episode_index)
        return shard.step(row, step, views=views, segm=segm)

    def batch(self, episode_index: int) -> pa.RecordBatch:
        """Read one episode as it is stored: a row with the columns of `schema.COLUMNS`."""
        shard, row = self._checked(episode_index)
        return shard.batch(row)

    def locate(self, episode_index: int) -> tuple[str, int]:
        """Return the shard's file name and the row in it where an episode is."""
        return self._names[self._name_of[episode_index]], int(self._rows[episode_index])

    def locations(self, indices: Sequence[int] | np.ndarray) -> list[tuple[str, int]]:
        """Return where several episodes are, as `locate` does."""
        rows = np.asarray(indices, np.int64)
        names = [self._names[number] for number in self._name_of[rows].tolist()]
        return list(zip(names, self._rows[rows].tolist(), strict=True))

    def shard_names(self) -> list[str]:
        """Return the file names of all shards that hold episodes of this data set."""
        return list(self._names)

    def shard(self, name: str) -> Shard:
        """Return an open shard.

        Args:
            name: Its file name.
        """
        if name not in self._shards:
            self._shards[name] = Shard(self.path / name, Envelope.from_entry(self.manifest["shards"][name]))
        return self._shards[name]

    def __reduce__(self) -> tuple[Any, ...]:  # Any: what pickle takes
        return _reopened, (self.path, self.tasks)

    def _checked(self, episode_index: int) -> tuple[Shard, int]:
        """The shard and row of an episode whose bytes are what the index says."""
        if not -len(self) <= episode_index < len(self):
            raise IndexError(f"episode {episode_index} of {len(self)}; count from 0 to {len(self) - 1}.")
        name, row = self.locate(episode_index)
        shard = self.shard(name)
        shard.check(row, Span(*(int(numbers[episode_index]) for numbers in self._spans)))
        return shard, row


def read_manifest(folder: Path) -> dict[str, Any]:  # Any: JSON
    """Read the manifest of a data folder.

    Raises:
        DatasetError: There is none, or it is damaged or of another version.
    """
    path = folder / MANIFEST_NAME
    try:
        return parse_manifest(read_inside(path))
    except (FileNotFoundError, NotADirectoryError):
        raise DatasetError(why_no_data_set(folder)) from None
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}. {remedy(folder)}") from None


def why_no_data_set(folder: Path) -> str:
    """Say what is wrong with a path where no manifest is, and what helps."""
    if folder.is_file():
        return f"{folder} is a file; give the folder that holds the data set, such as {folder.parent}."
    if not folder.is_dir():
        out = shlex.quote(str(folder))
        return f"there is no folder {folder}; `openvima generate --out {out}` makes one."
    if any(folder.glob("*.arrow")):
        return f"{folder} is not finished: repeat the command that writes it ({MANIFEST_NAME} is missing)."
    inner = sorted(str(path.parent) for path in folder.glob(f"*/{MANIFEST_NAME}"))
    hint = f", but these do: {', '.join(inner[:5])}{', …' if len(inner) > 5 else ''}" if inner else ""
    return f"{folder} holds no data set ({MANIFEST_NAME} is missing){hint}."


def of_tasks(index: pa.Table, tasks: Sequence[str] | None, folder: Path) -> np.ndarray:
    """Tell which episodes are of some tasks.

    Args:
        index: The episodes.
        tasks: Names of tasks; None means all.
        folder: Where they are, for the message.

    Returns:
        Shape (N,), bool.

    Raises:
        DatasetError: No task is named, or there are no episodes of one.
    """
    present = np.array(index.column("task").to_pylist(), dtype=str)
    if tasks is None:
        return np.ones(len(present), bool)
    known = sorted(set(present.tolist()))
    if not tasks:
        raise DatasetError(f"no task is named; {folder} has {', '.join(known)}.")
    for task in tasks:
        if task not in known:
            raise DatasetError(unknown_name(f"task in {folder} called", task, known))
    return np.isin(present, tasks)


def _reopened(path: Path, tasks: tuple[str, ...] | None) -> Dataset:
    return Dataset(path, tasks=tasks)


def _read_index(folder: Path, manifest: dict[str, Any]) -> pa.Table:  # Any: JSON
    path = folder / INDEX_NAME
    try:
        return parse_index(read_inside(path), manifest)
    except FileNotFoundError:
        raise DatasetError(f"{path} is missing. {remedy(folder)}") from None
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}. {remedy(folder)}") from None


def _check_shards(folder: Path, names: Sequence[str]) -> None:
    missing = [name for name in names if not (folder / name).is_file()]
    if missing:
        raise DatasetError(
            f"{folder} lacks {len(missing)} of {len(names)} shards, first {missing[0]}. {remedy(folder)}"
        )
    outside = [name for name in names if not is_inside(folder / name)]
    if outside:
        raise DatasetError(f"{folder / outside[0]} is a link that leads out of the folder. {remedy(folder)}")
