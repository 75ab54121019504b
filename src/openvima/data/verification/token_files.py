"""Checking the token cache: that it holds what would be cut out of the demonstrations now.

What a detector found is not looked for again. Of such tokens only what depends on no detector is compared.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path

import numpy as np

from openvima.data.manifest import CACHE_FOLDER
from openvima.data.object_cache.cache_file import CacheFile
from openvima.data.object_cache.episode import PreprocessedEpisode, preprocess
from openvima.data.shard import Shard
from openvima.data.verification.findings import Problem, Report, by_cause
from openvima.errors import OpenVimaError, ShardError
from openvima.multiprocess import in_processes

# What tokens hold whatever found the objects.
_OF_ALL = ("task", "seed", "end_effector", "actions")


@dataclass(frozen=True, slots=True)
class TokenTask:
    """A file of tokens to look at.

    Args:
        path: The file.
        shard: The shard of which it was made.
        content_hash: Of the episodes of that shard together.
        shown_as: Its name in messages, relative to the data folder.
    """

    path: Path
    shard: Path
    content_hash: str
    shown_as: str


@dataclass(frozen=True, slots=True)
class Compared:
    """What came of comparing tokens.

    Args:
        num_files: How many were compared; those that are out of date were not.
        problems: What is wrong with files of tokens.
    """

    num_files: int
    problems: tuple[Problem, ...]


def check_tokens(
    folder: Path, content_hashes: dict[str, str], num_workers: int, report: Report | None = None
) -> Compared:
    """Compare the token cache of a data set with the demonstrations, episode by episode.

    Args:
        folder: The data folder.
        content_hashes: Name of each whole shard to the hash of its episodes together.
        num_workers: Number of processes.
        report: Called with episodes done, episodes in all, and what is being done.
    """
    files = sorted((folder / CACHE_FOLDER).glob("*/*.arrow"))
    tasks = [
        TokenTask(path, folder / path.name, content_hashes[path.name], str(path.relative_to(folder)))
        for path in files
        if path.name in content_hashes
    ]
    total = sum(len(Shard(task.shard)) for task in tasks)
    watch = None if report is None else (lambda done: report(done, total, "comparing tokens"))
    remedy = "Delete it; `openvima data tokens` makes it anew."
    num_files, problems = 0, []
    for task, causes in in_processes(check_token_file, tasks, num_workers, report=watch):
        if causes is not None:
            num_files += 1
            problems += [Problem(task.shown_as, cause, remedy) for cause in causes]
    return Compared(num_files, tuple(problems))


def check_token_file(task: TokenTask, count: Callable[[int], None]) -> Sequence[str] | None:
    """Compare a file of tokens with its shard.

    Args:
        task: The file.
        count: Called with the number of episodes compared so far.

    Returns:
        What is wrong; None where the file is out of date, for then it is made anew before it is used.
    """
    try:
        tokens = CacheFile(task.path)
    except ShardError as error:
        return [str(error).removeprefix(f"{task.path} ").split(". ")[0]]
    if tokens.source != task.content_hash:
        return None
    shard = Shard(task.shard)
    if len(tokens) != len(shard):
        return [f"it has {len(tokens)} of {len(shard)} episodes"]
    return by_cause(_differences(tokens, shard, count), len(shard))


def _differences(tokens: CacheFile, shard: Shard, count: Callable[[int], None]) -> Iterator[tuple[int, str]]:
    for row in range(len(shard)):
        try:
            names = _OF_ALL if tokens.boxes else [field.name for field in fields(PreprocessedEpisode)]
            ours, theirs = tokens[row], preprocess(shard[row], tokens.kind)
            is_same = ours.prompt.text == theirs.prompt.text and _is_same(ours, theirs, names)
        except OpenVimaError as error:
            yield row, f"its tokens cannot be compared: {error}"
            continue
        if not is_same:
            yield row, "its tokens are not those of the demonstration"
        count(row + 1)


def _is_same(ours: object, theirs: object, names: Sequence[str]) -> bool:
    return all(_is_equal(getattr(ours, name), getattr(theirs, name)) for name in names)


def _is_equal(ours: object, theirs: object) -> bool:
    """Compare two values; records field by field."""
    if is_dataclass(ours):
        return _is_same(ours, theirs, [field.name for field in fields(ours)])
    return np.array_equal(ours, theirs)  # type: ignore[arg-type]  # numbers, strings and arrays
