"""Checking one shard: bytes, schema, and every record."""

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from openvima.data.checksums import Envelope, mapped, spans_of
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import ShardSummary, fingerprint, is_inside, summarise
from openvima.data.shard import Shard, remedy
from openvima.data.verification.episodes import faults
from openvima.data.verification.findings import Problem, by_cause
from openvima.env.config import ENV_SETTINGS
from openvima.errors import OpenVimaError, ShardError
from openvima.scene.command import PRIMITIVES
from openvima.tasks.prompts import MULTIMODAL

_KEY_COLUMNS = ("task", "level", "domain", "seed", "steps", "content_hash", "success")


@dataclass(frozen=True, slots=True, eq=False)
class ShardTask:
    """A shard to check.

    Args:
        path: The file.
        label: Its name in messages, relative to the data folder.
        entry: Its entry in the manifest; None where that cannot be trusted.
        index: Its part of the index; None where that cannot be trusted.
        config: Settings of the manifest that all generated shards share; empty for others.
        versions: Those of the manifest, for generated shards; empty for others.
        is_failed: Whether it holds unsolved episodes.
        remedy: How to repair it.
    """

    path: Path
    label: str
    entry: dict[str, Any] | None  # Any: JSON
    index: pa.Table | None
    config: dict[str, Any]  # Any: JSON
    versions: dict[str, str]
    is_failed: bool
    remedy: str


@dataclass(frozen=True, slots=True, eq=False)
class ShardFindings:
    """Result of checking a shard.

    Args:
        problems: All problems.
        is_damaged: Whether it is missing or has other bytes than were written.
        summary: Its rows of the index and its entry of the manifest, as they should be; None if unreadable.
        info: Its metadata; None if unreadable.
        num_episodes: Records that were decoded.
    """

    problems: tuple[Problem, ...]
    is_damaged: bool
    summary: ShardSummary | None = None
    info: ShardInfo | None = None
    num_episodes: int = 0


def check_shard(task: ShardTask, count: Callable[[int], None]) -> ShardFindings:
    """Check a shard.

    Args:
        task: The shard.
        count: Called with the number of episodes checked so far.
    """
    causes = list(_byte_faults(task))
    if causes:
        return ShardFindings(_problems(task, causes), is_damaged=True)
    known = None if task.entry is None else {key: task.entry[key] for key in ("bytes", "sha256")}
    try:
        shard = Shard(task.path)
        summary = summarise(task.path, known)
    except ShardError as error:
        return ShardFindings(_problems(task, [_cause(error, task.path)]), is_damaged=True)
    found = list(_record_faults(task, shard, count))
    is_damaged = any(is_damage for _, _, is_damage in found)
    causes = by_cause(((row, cause) for row, cause, _ in found), len(shard))
    causes += [*_info_faults(task, shard.info), *_summary_faults(task, summary)]
    return ShardFindings(_problems(task, causes), is_damaged, summary, shard.info, len(shard))


def _problems(task: ShardTask, causes: Sequence[str]) -> tuple[Problem, ...]:
    return tuple(Problem(task.label, cause, task.remedy) for cause in causes)


def _cause(error: OpenVimaError, path: Path) -> str:
    """Return a reader's error message without file, record and remedy, which a problem adds."""
    text = str(error).removesuffix(f" {remedy(path.parent)}").removesuffix(".")
    return re.sub(rf"^{re.escape(str(path))}(, record \d+)?: (record \d+ of \d+ is )?", "", text)


def _byte_faults(task: ShardTask) -> Iterator[str]:
    """Yield damage of the bytes, with its place."""
    if not task.path.is_file():
        yield "it is missing"
        return
    if not is_inside(task.path):
        yield "it is a link that leads out of the folder"
        return
    if task.entry is None:
        return
    found = fingerprint(task.path)
    if (found["bytes"], found["sha256"]) == (task.entry["bytes"], task.entry["sha256"]):
        return
    content = memoryview(b"") if found["bytes"] == 0 else mapped(task.path)
    places = [Envelope.from_entry(task.entry).fault_in(content)]
    if task.index is not None:
        broken = [row for row, span in enumerate(spans_of(task.index)) if span.fault_in(content)]
        places += by_cause(((row, "damaged") for row in broken), task.index.num_rows)
    where = "; ".join(place for place in places if place)
    yield f"its bytes are not those that were written{f': {where}' if where else ''}"


def _record_faults(
    task: ShardTask, shard: Shard, count: Callable[[int], None]
) -> Iterator[tuple[int, str, bool]]:
    """Yield row, fault, and whether damaged bytes are the cause."""
    keys = shard.table(_KEY_COLUMNS).to_pylist()
    for row, key in enumerate(keys):
        try:
            demo = shard[row]
        except ShardError as error:
            yield row, _cause(error, shard.path), shard.info.images
            continue
        except OpenVimaError as error:  # the asset pack that its images need is not there
            yield row, f"its images cannot be rendered: {error}", False
            continue
        # Rendered images were compared on reading.
        if shard.info.images and demo.content_hash() != key["content_hash"]:
            yield row, "its content hash is not that of its content", True
        if demo.num_steps != key["steps"]:
            yield row, "it does not have as many actions as steps", False
        if task.config and demo.outcome.success == task.is_failed:
            yield row, f"it is {'' if task.is_failed else 'not '}solved", False
        yield from ((row, fault, False) for fault in faults(demo))
        count(row + 1)
    if task.config:
        for row, (before, after) in enumerate(itertools.pairwise(key["seed"] for key in keys), start=1):
            if after <= before:
                yield row, "its seed does not follow that of the record before", False


def _info_faults(task: ShardTask, info: ShardInfo) -> Iterator[str]:
    """Yield contradictions between a generated shard and the manifest."""
    settings = (
        {"prompts": MULTIMODAL, "task_options": "", "control": PRIMITIVES, **task.config}
        if task.config
        else {}
    )
    for name in ("level", "domain", *ENV_SETTINGS, "compression", "images"):
        if name in settings and getattr(info, name) != settings[name]:
            there, stated = str(getattr(info, name)) or "none", str(settings[name]) or "none"
            yield f"{name} is {there}, in the manifest {stated}"
    if task.versions and info.versions != task.versions:
        yield f"it was written by {info.versions}, says the manifest {task.versions}"
    if task.config and task.path.name != info.file_name:
        yield f"it says that it is {info.file_name}"


def _summary_faults(task: ShardTask, summary: ShardSummary) -> Iterator[str]:
    """Yield contradictions of manifest and index with the shard."""
    if task.entry is not None and summary.entry != task.entry:
        names = [key for key, value in task.entry.items() if summary.entry.get(key) != value]
        if names:
            yield f"the manifest says otherwise of its {', '.join(names)}"
    if task.index is not None and not task.index.combine_chunks().equals(summary.index.combine_chunks()):
        names = [
            name
            for name in summary.index.column_names
            if summary.index.column(name).to_pylist() != task.index.column(name).to_pylist()
        ]
        yield f"the index says otherwise of its {', '.join(names)}"
