"""Reading a folder of demonstrations, or one on the Hugging Face Hub, as a sequence of episodes."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.catalog import LEVELS, OBJECTS, TEXTURES
from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME, read_index, read_manifest, split_index
from openvima.data.records import Demonstration
from openvima.data.shard import SPAN, Shard, remedy
from openvima.errors import MAX_CHARACTERS, DatasetError, cut, unknown_name
from openvima.html import notebook_html
from openvima.hub import cache_folder, dataset_name, fetch
from openvima.input_files import as_path, names_of


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
        DatasetError: A shard is damaged; raised when it is first read.
        ServerError: The Hub has no such data set, or cannot be reached.

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
        index = read_index(self.path, self.manifest)
        if self.tasks is not None:
            index = index.filter(select_tasks(index, self.tasks, str(self.path)))
        self.index = index
        names = self.index.column("shard").combine_chunks().dictionary_encode()
        self._names = names.dictionary.to_pylist()
        self._name_of = names.indices.to_numpy()  # numbers instead of a million texts
        self._rows = self.index.column("row").to_numpy()
        self._spans = [self.index.column(name).to_numpy() for name in SPAN]
        self._shards: dict[str, Shard] = {}
        missing = [name for name in sorted(self._names) if not (self.path / name).is_file()]
        if missing and not index_only:
            raise DatasetError(
                f"{self.path} lacks {len(missing)} of {len(self._names)} shards, first {missing[0]}. "
                f"{remedy(self.path)}"
            )

    def __repr__(self) -> str:
        tasks = ", ".join(self.tasks or self.manifest["tasks"])
        return cut(f"Dataset({str(self.path)!r}, {len(self):,} demonstrations: {tasks})", MAX_CHARACTERS)

    def _repr_html_(self) -> str | None:
        return notebook_html("dataset", dataset=self)

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, episode_index: int) -> Demonstration:
        shard, row = self._checked(episode_index)
        return shard[row]

    def __iter__(self) -> Iterator[Demonstration]:
        return (self[episode_index] for episode_index in range(len(self)))

    def read(self, episode_index: int, columns: Sequence[str]) -> dict[str, Any]:
        """Read some columns of one episode, as `Shard.read` does.

        Example:
            >>> Dataset("demos").read(0, ["rgb_top", "pose0_position"])["rgb_top"].shape
            (2, 128, 256, 3)
        """
        shard, row = self._checked(episode_index)
        return shard.read(row, columns)

    def batch(self, episode_index: int) -> pa.RecordBatch:
        """Read one episode as it is stored: a row with the columns of `schema.COLUMNS`."""
        shard, row = self._checked(episode_index)
        return shard.batch(row)

    def locate(self, episode_index: int) -> tuple[str, int]:
        """Return the shard's file name and the row in it where an episode is."""
        return self._names[self._name_of[episode_index]], int(self._rows[episode_index])

    def shard_names(self) -> list[str]:
        """Return the file names of all shards that hold episodes of this data set."""
        return list(self._names)

    def shard(self, name: str) -> Shard:
        """Return an open shard.

        Args:
            name: Its file name.
        """
        if name not in self._shards:
            self._shards[name] = Shard(self.path / name, self.manifest["shards"][name])
        return self._shards[name]

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Dataset, tasks=self.tasks), (self.path,)

    def _checked(self, episode_index: int) -> tuple[Shard, int]:
        """The shard and row of an episode whose bytes are what the index says."""
        if not -len(self) <= episode_index < len(self):
            raise IndexError(f"episode {episode_index} of {len(self)}; count from 0 to {len(self) - 1}.")
        name, row = self.locate(episode_index)
        shard = self.shard(name)
        shard.check(row, *(int(numbers[episode_index]) for numbers in self._spans))
        return shard, row


def select_tasks(index: pa.Table, tasks: Sequence[str] | None, where: str) -> np.ndarray:
    """Tell which episodes are of some tasks.

    Args:
        index: The episodes.
        tasks: Names of tasks; None means all.
        where: Where they are, for the message.

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
        raise DatasetError(f"no task is named; in {where} are {', '.join(known)}.")
    for task in tasks:
        if task not in known:
            raise DatasetError(unknown_name(f"task in {where} called", task, known))
    return np.isin(present, tasks)


def data_folder(path: str | Path, *, shards: bool = True) -> Path:
    """Return the folder of a data set; one on the Hub is downloaded, into a folder of its commit.

    Args:
        path: A folder, or the name of a data set on the Hub such as "hf://owner/name@revision".
        shards: Whether to fetch the shards that its manifest lists; else manifest and index only. No other
            file of the repository is fetched.

    Returns:
        The folder. Of one on the Hub only the manifest was checked, as readers check shards.

    Raises:
        ServerError: There is no such repository, or it cannot be reached.
        DatasetError: It holds no data set, or its manifest is damaged.
        MissingExtraError: `huggingface_hub` is not installed.
    """
    name = dataset_name(path)
    if name is None:
        return as_path(path)
    # The client's cache has a folder per commit, of links. A data set must be of plain files.
    commit = fetch(name, (MANIFEST_NAME,), kind="dataset").name
    fixed, folder = replace(name, revision=commit), cache_folder(name, commit)
    fetch(fixed, (MANIFEST_NAME, INDEX_NAME), kind="dataset", into=folder)
    if not (folder / MANIFEST_NAME).is_file():
        raise DatasetError(f"{name} on the Hugging Face Hub holds no data set ({MANIFEST_NAME} is missing).")
    if shards:
        fetch(fixed, list(read_manifest(folder)["shards"]), kind="dataset", into=folder)
    return folder


def split_hashes(index: pa.Table, purpose: str = "") -> np.ndarray:
    """Return a uniform number between 0 and 1 for each demonstration, shape (N,), float64.

    It follows from its task and seed alone, so that it stays when data are added.

    Args:
        index: Of the demonstrations: `Dataset.index`.
        purpose: Other purposes have other numbers.
    """
    names = zip(index.column("task").to_pylist(), index.column("seed").to_pylist(), strict=True)
    return hash_names(f"{purpose}{task}/{seed}" for task, seed in names) / 2.0**64


def hash_names(names: Iterable[str]) -> np.ndarray:
    """Hash names to 64 bits each, shape (N,), uint64."""
    digests = (hashlib.blake2b(name.encode(), digest_size=8).digest() for name in names)
    return np.frombuffer(b"".join(digests), "<u8")


def find_demonstrations(
    dataset: Dataset,
    *,
    task: str = "",
    level: str = "",
    object: str = "",
    texture: str = "",
    min_steps: int = 0,
    max_steps: int | None = None,
) -> np.ndarray:
    """Find demonstrations; empty arguments admit all.

    Shards are read only for objects and textures, without images, and only those with candidates.

    Args:
        dataset: The data set.
        task: Name of the task.
        level: one of `openvima.catalog.LEVELS`.
        object: Object of the catalogue that is on the table.
        texture: Texture on the table; together with `object`, of that object.
        min_steps: Fewest steps.
        max_steps: Most steps; None for no limit.

    Returns:
        Indices into the data set, ascending, int64.

    Raises:
        DatasetError: The data set has no such task, or there is no such level, object or texture.
        DatasetError: A shard is damaged.
    """
    index = dataset.index
    steps = index.column("steps").to_numpy()
    chosen = (steps >= min_steps) & (steps <= (np.inf if max_steps is None else max_steps))
    asked = {"task": task, "level": level, "object": object, "texture": texture}
    allowed = {"task": dataset.manifest["tasks"], "level": LEVELS, "object": OBJECTS, "texture": TEXTURES}
    shown = {}  # on the table, of which the index knows nothing
    for field, name in asked.items():
        if name and name not in allowed[field]:
            raise DatasetError(unknown_name(field, name, allowed[field]))
        if name and field in index.column_names:
            chosen &= index.column(field).to_numpy() == name
        elif name:
            shown[field] = name
    end = 0
    for shard_name, part in split_index(index).items() if shown else ():
        start, end = end, end + part.num_rows
        if chosen[start:end].any():
            chosen[start:end] &= _shows(dataset.shard(shard_name), shown)
    return np.flatnonzero(chosen)


def _shows(shard: Shard, shown: Mapping[str, str]) -> np.ndarray:
    """Whether each demonstration of a shard has an object with these fields, shape (N,), bool."""
    lists = shard.table(["objects"]).column("objects").combine_chunks()
    objects: pa.StructArray = lists.flatten()
    fits = np.ones(len(objects), bool)
    for field, name in shown.items():
        fits &= objects.field(field).to_numpy(zero_copy_only=False) == name
    owners = np.repeat(np.arange(len(lists)), lists.value_lengths().to_numpy())
    return np.bincount(owners[fits], minlength=len(lists)) > 0
