"""Writing the shards of a data set that is made of others."""

import shlex
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from openvima.data.encoding import ShardInfo
from openvima.data.manifest import fingerprint
from openvima.data.planning import LARGEST_SHARD
from openvima.data.reader import Dataset
from openvima.data.writer import ShardWriter
from openvima.errors import DatasetError, ShardError
from openvima.multiprocess import imap_unordered


@dataclass(frozen=True, slots=True)
class NewShard:
    """A shard that is to be put together of rows of others.

    Args:
        path: The file.
        info: What all its rows have in common.
        source: Folder of the data set that holds the rows.
        checksum: Of that data set's manifest.
        episodes: Numbers of the rows in the data set, in order.
    """

    path: Path
    info: ShardInfo
    source: Path
    checksum: str
    episodes: tuple[int, ...]

    @property
    def num_episodes(self) -> int:
        """Number of rows."""
        return len(self.episodes)


@dataclass(frozen=True, slots=True)
class CopiedShard:
    """A shard that is to be copied as it is.

    Args:
        path: The file.
        original: The file to copy.
        sha256: What its bytes must give, in hexadecimal digits.
        num_episodes: Number of rows.
    """

    path: Path
    original: Path
    sha256: str
    num_episodes: int


def write_shard(shard: NewShard | CopiedShard, count: Callable[[int], None]) -> None:
    """Write one shard; episodes are read, checked and written one by one.

    Args:
        shard: What to write.
        count: Called with the number of episodes written so far.

    Raises:
        ShardError: What is read is damaged.
    """
    if isinstance(shard, CopiedShard):
        _copy(shard)
        count(shard.num_episodes)
        return
    dataset = _dataset(shard.source, shard.checksum)
    with ShardWriter(shard.path, shard.info) as writer:
        for number, episode_index in enumerate(shard.episodes, start=1):
            writer.copy(dataset.batch(episode_index))
            count(number)


def write_shards(
    shards: Sequence[NewShard | CopiedShard], num_workers: int, report: Callable[[int, int, str], None] | None
) -> None:
    """Write shards in several processes.

    Args:
        shards: What to write.
        num_workers: Number of processes.
        report: Called with episodes done, episodes in all, and a note.

    Raises:
        ShardError: What is read is damaged.
    """
    total = sum(shard.num_episodes for shard in shards)
    count = None if report is None else (lambda done: report(done, total, ""))
    for _ in imap_unordered(write_shard, shards, num_workers, report=count):
        pass  # a shard's result is its file


def plan_shards(
    dataset: Dataset, episodes: Sequence[int], folder: Path, compression: str | None
) -> list[NewShard]:
    """Divide chosen episodes into shards of equal settings, numbered by task and level.

    Args:
        dataset: Where they are.
        episodes: Their numbers, ascending.
        folder: Where the shards shall lie.
        compression: Codec; None keeps that of each source shard.
    """
    commons: dict[str, tuple[tuple[str | bytes, ...], ShardInfo]] = {}  # of each source shard
    groups: dict[tuple[str | bytes, ...], tuple[ShardInfo, list[int]]] = {}
    for episode_index in episodes:
        name, _ = dataset.locate(episode_index)
        if name not in commons:
            info = dataset.shard(name).info
            codec = compression or info.compression
            common = replace(info, number=0, shard_size=0, first_seed=0, compression=codec)
            commons[name] = (info.task, info.level, *common.to_metadata().values()), common
        key, common = commons[name]
        groups.setdefault(key, (common, []))[1].append(episode_index)
    names = ShardNames(folder)
    return [
        names.new_shard(info, dataset, members[start : start + LARGEST_SHARD])
        for _, (info, members) in sorted(groups.items())
        for start in range(0, len(members), LARGEST_SHARD)
    ]


class ShardNames:
    """Names of the shards of a folder: those of each task and level are numbered from 0."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._numbers: dict[tuple[str, str], int] = {}

    def numbered(self, info: ShardInfo) -> tuple[Path, ShardInfo]:
        """Give a shard the next number of its task and level, and its place."""
        number = self._numbers.get((info.task, info.level), 0)
        self._numbers[info.task, info.level] = number + 1
        info = replace(info, number=number)
        return self._folder / info.file_name, info

    def new_shard(self, info: ShardInfo, dataset: Dataset, episodes: Sequence[int]) -> NewShard:
        """Plan the next shard of a task and level."""
        path, info = self.numbered(info)
        return NewShard(path, info, dataset.path, dataset.manifest["checksum"], tuple(episodes))


def _copy(shard: CopiedShard) -> None:
    shutil.copyfile(shard.original, shard.path)
    if fingerprint(shard.path)["sha256"] != shard.sha256:
        raise ShardError(
            f"{shard.original} is damaged: its checksum is not that of the manifest. "
            f"`openvima data verify {shlex.quote(str(shard.original.parent))}` says more."
        )


@lru_cache(maxsize=2)
def _dataset(folder: Path, checksum: str) -> Dataset:
    dataset = Dataset(folder)
    if dataset.manifest["checksum"] != checksum:
        raise DatasetError(f"{folder} was changed while it was read. Repeat the command.")
    return dataset
