"""Reading demonstrations: single shards, and whole folders by episode."""

import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from openvima.data.checksums import Frame, Span, mapped
from openvima.data.columns import columns_of, planes
from openvima.data.decoding import actions_in, decode, decode_columns
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME, parse_index, parse_manifest
from openvima.data.records import Demonstration, Step
from openvima.data.schema import COLUMNS, IMAGES, SCHEMA_VERSION, VIEWS
from openvima.errors import DatasetError, ShardError, unknown_name
from openvima.scene import ACTION_SHAPES, END_EFFECTORS

# What Arrow raises when it is given damaged bytes.
ODD_ERRORS = (pa.ArrowException, OSError, ValueError, TypeError, LookupError, ArithmeticError, MemoryError)


class Shard:
    """One file of demonstrations; rows are read on demand.

    Damage that keeps Arrow from reading is an error in any case. Changed pixels and numbers are noticed where
    checksums are given, as `Dataset` does, and by `openvima data verify`.

    Args:
        path: The file.
        frame: Checksum of all that surrounds the records, as the folder's manifest holds it.

    Raises:
        ShardError: It is missing, truncated, damaged, or no shard of this package.
    """

    def __init__(self, path: Path, frame: Frame | None = None) -> None:
        self.path = path
        self._content = _mapped(path)
        if frame is not None and (fault := frame.fault_in(self._content)):
            raise ShardError(_damaged(path, "it", fault))
        self._reader = _opened(path, self._content)
        self._readers: dict[tuple[str, ...], pa.RecordBatchFileReader] = {}  # of some columns each
        try:
            self.info = ShardInfo.from_metadata(self._reader.schema.metadata)
        except ShardError as error:
            raise ShardError(f"{path}: {error}") from None
        if not self._reader.schema.equals(COLUMNS):
            raise ShardError(f"{path} has other columns than schema version {SCHEMA_VERSION} asks for.")

    def __len__(self) -> int:
        return self._reader.num_record_batches

    def __getitem__(self, row: int) -> Demonstration:
        batch = self.batch(row)
        try:
            demo = decode(batch, self.info)
        except ODD_ERRORS as error:
            raise self._row_error(row, error) from None
        if self.info.images:
            return demo
        from openvima.data.rerender import redrawn  # with which the renderer comes

        try:
            return redrawn(demo, self.info, batch.column("content_hash")[0].as_py())
        except ShardError as error:
            raise ShardError(f"{self.path}, record {row}: {error}") from None

    def read(self, row: int, columns: Sequence[str]) -> dict[str, Any]:  # Any: one column, one type
        """Read some columns of one row; nothing is decompressed for the others.

        Args:
            row: The row.
            columns: Names out of `schema.COLUMNS`; docs/format.md lists them.

        Returns:
            Column name to value: an array for poses, actions and images (colours last, as they are stored), a
            list of arrays for joint paths, and else texts, numbers, lists and dictionaries.

        Raises:
            DatasetError: There is no such column.
            ShardError: The row is damaged.
        """
        needed = (*columns, "steps") if "poses" in columns else tuple(columns)
        batch = self._batch(self._reader_of(needed), row)
        try:
            values = decode_columns(batch)
        except ODD_ERRORS as error:
            raise self._row_error(row, error) from None
        if not self.info.images and not IMAGES.isdisjoint(columns):
            values |= columns_of(self[row]).images
        return {name: values[name] for name in columns}

    def step(self, row: int, step: int, *, views: Sequence[str] = VIEWS, segm: bool = True) -> Step:
        """Read one step of one row.

        Args:
            row: The row.
            step: Which one, from 0.
            views: What of "front" and "top" to read.
            segm: Whether to read segmentation too.

        Raises:
            IndexError: The episode has fewer steps.
            DatasetError: There is no such view.
            ShardError: The row is damaged.
        """
        for view in views:
            if view not in VIEWS:
                raise DatasetError(unknown_name("view", view, VIEWS))
        kinds = ("rgb", "segm") if segm else ("rgb",)
        images = [f"{kind}_{view}" for kind in kinds for view in views]
        values = self.read(row, [*images, *ACTION_SHAPES, "end_effector"])
        actions = actions_in(values)
        if not 0 <= step < len(actions):
            raise IndexError(f"step {step} of {len(actions)}; count from 0 to {len(actions) - 1}.")
        observation: dict[str, Any] = {  # Any: as an environment's
            "rgb": {view: planes(values[f"rgb_{view}"][step : step + 1])[0] for view in views},
            "ee": END_EFFECTORS.index(values["end_effector"]),
        }
        if segm:
            observation["segm"] = {view: values[f"segm_{view}"][step] for view in views}
        return Step(observation, actions[step])

    def batch(self, row: int) -> pa.RecordBatch:
        """Read one row as it is stored.

        Raises:
            IndexError: There are fewer rows.
            ShardError: It is damaged.
        """
        return self._batch(self._reader, row)

    def _batch(self, reader: pa.RecordBatchFileReader, row: int) -> pa.RecordBatch:
        if not 0 <= row < len(self):  # which also ends loops over a shard
            raise IndexError(f"record {row} of {len(self)} in {self.path}; count from 0 to {len(self) - 1}.")
        try:
            batch = reader.get_batch(row)
            batch.validate(full=True)  # 4 µs; offsets that lead out of a buffer would end the process
        except ODD_ERRORS as error:
            raise self._row_error(row, error) from None
        return batch

    def check(self, row: int, span: Span) -> None:
        """Compare the bytes of a row with their checksum, before anything is made of them.

        Args:
            row: The row.
            span: Where the index says that it lies.

        Raises:
            ShardError: They are damaged.
        """
        if fault := span.fault_in(self._content):
            raise self._row_error(row, fault)

    def table(self, names: Sequence[str]) -> pa.Table:
        """Read some columns of all rows, without touching the others.

        Args:
            names: Columns of `schema.COLUMNS`.
        """
        try:
            table = self._reader_of(names).read_all()
            table.validate(full=True)  # as for a row
        except ODD_ERRORS as error:
            raise ShardError(_damaged(self.path, "its records", error)) from None
        return table.select(list(names))

    def _reader_of(self, columns: Sequence[str]) -> pa.RecordBatchFileReader:
        """A reader to which the other columns do not exist."""
        key = tuple(columns)
        if key not in self._readers:
            for name in columns:
                if name not in COLUMNS.names:
                    raise DatasetError(unknown_name("column", name, COLUMNS.names))
            numbers = [COLUMNS.get_field_index(name) for name in columns]
            self._readers[key] = _opened(self.path, self._content, numbers)
        return self._readers[key]

    def _row_error(self, row: int, error: Exception | str) -> ShardError:
        return ShardError(_damaged(self.path, f"record {row} of {len(self)}", error))


class Dataset:
    """A folder of demonstrations as a sequence; an episode is read when it is asked for.

    Episodes come in the order in which they are stored. Objects can be sent to other processes: they open
    files anew.

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
        index = _read_index(self.path, self.manifest)
        self.index = index.filter(of_tasks(index, self.tasks, self.path)) if self.tasks is not None else index
        names = self.index.column("shard").combine_chunks().dictionary_encode()
        self._names = names.dictionary.to_pylist()
        self._name_of = names.indices.to_numpy()  # numbers instead of a million texts
        self._rows = self.index.column("row").to_numpy()
        self._spans = [self.index.column(name).to_numpy() for name in ("offset", "num_bytes", "crc32")]
        self._shards: dict[str, Shard] = {}
        _check_shards(self.path, sorted(self._names))

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

    def shard_names(self) -> list[str]:
        """Return the file names of all shards that hold episodes of this data set."""
        return list(self._names)

    def shard(self, name: str) -> Shard:
        """Return an open shard.

        Args:
            name: Its file name.
        """
        if name not in self._shards:
            self._shards[name] = Shard(self.path / name, Frame.from_entry(self.manifest["shards"][name]))
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
    if not path.is_file():
        raise DatasetError(why_no_data_set(folder))
    try:
        return parse_manifest(path.read_bytes())
    except DatasetError as error:
        raise DatasetError(f"{path}: {error}. {remedy(folder)}") from None


def remedy(folder: Path) -> str:
    """Return a sentence that says what makes a damaged folder whole."""
    return (
        f"`openvima data verify {shlex.quote(str(folder))} --repair` makes it anew, or keeps what is whole."
    )


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


def _mapped(path: Path) -> memoryview:
    try:
        return mapped(path)
    except FileNotFoundError:
        raise ShardError(f"there is no file {path}. {remedy(path.parent)}") from None
    except ODD_ERRORS as error:
        raise ShardError(_damaged(path, "it", error)) from None


def _opened(path: Path, content: memoryview, columns: list[int] | None = None) -> pa.RecordBatchFileReader:
    options = pa.ipc.IpcReadOptions(use_threads=False, included_fields=columns)
    try:
        return pa.ipc.open_file(pa.py_buffer(content), options=options)
    except ODD_ERRORS as error:
        raise ShardError(_damaged(path, "it", error)) from None


def _damaged(path: Path, what: str, error: Exception | str) -> str:
    reason = (str(error).splitlines() or [type(error).__name__])[0]
    return f"{path}: {what} is truncated, damaged or no shard ({reason}). {remedy(path.parent)}"


def _read_index(folder: Path, manifest: dict[str, Any]) -> pa.Table:  # Any: JSON
    path = folder / INDEX_NAME
    try:
        return parse_index(path.read_bytes(), manifest)
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
