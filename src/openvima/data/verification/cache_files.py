"""Checking the object cache: whether it holds what `preprocess` makes of the demonstrations now.

Detectors do not run again. Of what they found, only the fields that depend on no detector are compared.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

import numpy as np

from openvima.data.manifest import CACHE_FOLDER
from openvima.data.object_cache import CacheFile
from openvima.data.preprocessed import PreprocessedEpisode, preprocess
from openvima.data.shard import Shard
from openvima.data.verification.findings import Problem, Report, by_cause
from openvima.errors import OpenVimaError, ShardError
from openvima.multiprocess import imap_unordered

_REMEDY = "Delete it; `openvima data preprocess` makes it again."
_WITHOUT_OBJECTS = ("task", "seed", "end_effector", "actions")


@dataclass(frozen=True, slots=True)
class CacheTask:
    """A cache file to check.

    Args:
        path: The file.
        shard: The shard it was made from.
        content_hash: Joint hash of that shard's episodes.
    """

    path: Path
    shard: Path
    content_hash: str


def check_cache(
    folder: Path, content_hashes: dict[str, str], num_workers: int, report: Report | None = None
) -> tuple[int, list[Problem]]:
    """Compare the object cache of a data set with its demonstrations, episode by episode.

    Args:
        folder: The data folder.
        content_hashes: Name of each whole shard to the joint hash of its episodes.
        num_workers: Number of processes.
        report: Called with episodes done, episodes in all, and the current stage.

    Returns:
        Number of files that were compared, without outdated ones, and the problems.
    """
    tasks = [
        CacheTask(path, folder / shard, content_hash)
        for shard, content_hash in sorted(content_hashes.items())
        for path in sorted((folder / CACHE_FOLDER).glob(f"*/{shard}"))
    ]
    total = sum(len(Shard(task.shard)) for task in tasks)
    watch = None if report is None else (lambda done: report(done, total, "comparing the object cache"))
    num_files, problems = 0, []
    for task, causes in imap_unordered(check_cache_file, tasks, num_workers, report=watch):
        if causes is not None:
            num_files += 1
            name = str(task.path.relative_to(folder))
            problems += [Problem(name, cause, _REMEDY) for cause in causes]
    return num_files, problems


def check_cache_file(task: CacheTask, count: Callable[[int], None]) -> list[str] | None:
    """Compare a cache file with its shard.

    Args:
        task: The file.
        count: Called with the number of episodes compared so far.

    Returns:
        Problems; None if the file is outdated, for then it is replaced before it is used.
    """
    try:
        cached = CacheFile(task.path)
    except ShardError as error:
        return [str(error).removeprefix(f"{task.path} ").split(". ")[0]]
    if cached.source != task.content_hash:
        return None
    shard = Shard(task.shard)
    if len(cached) != len(shard):
        return [f"it has {len(cached)} of {len(shard)} episodes"]
    return by_cause(_differences(cached, shard, count), len(shard))


def _differences(cached: CacheFile, shard: Shard, count: Callable[[int], None]) -> Iterator[tuple[int, str]]:
    names = _WITHOUT_OBJECTS if cached.variant else [field.name for field in fields(PreprocessedEpisode)]
    for row in range(len(shard)):
        try:
            ours, theirs = cached[row], preprocess(shard[row], cached.kind)
        except OpenVimaError as error:
            yield row, f"it cannot be compared: {error}"
            continue
        is_left_out = cached.variant and not ours.num_steps
        if not is_left_out and (
            ours.prompt.text != theirs.prompt.text or not _are_equal(ours, theirs, names)
        ):
            yield row, "it differs from the demonstration"
        count(row + 1)


def _are_equal(ours: object, theirs: object, names: Iterable[str]) -> bool:
    """Compare some fields of two records, nested records field by field."""
    for name in names:
        a, b = getattr(ours, name), getattr(theirs, name)
        if is_dataclass(a):
            is_equal = _are_equal(a, b, [field.name for field in fields(a)])
        else:
            is_equal = np.array_equal(a, b)
        if not is_equal:
            return False
    return True
