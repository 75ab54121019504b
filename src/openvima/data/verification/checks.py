"""Verifying a data folder: manifest and index, shards, object cache, and a sample of replayed episodes."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from openvima.catalog.packs import load_assets
from openvima.data.manifest import (
    FAILED_FOLDER,
    INDEX_NAME,
    MANIFEST_NAME,
    ShardSummary,
    check_failed,
    compose,
    joint_hash,
)
from openvima.data.verification.cache_files import check_cache
from openvima.data.verification.findings import Problem, Report, Verification, VerifyConfig
from openvima.data.verification.inventory import Inventory, take_inventory
from openvima.data.verification.replay import replay
from openvima.data.verification.shards import ShardFindings, ShardTask, check_shard
from openvima.input_files import as_path
from openvima.multiprocess import imap_unordered
from openvima.user_code import is_code

DEFAULT = VerifyConfig()


def verify(folder: str | Path, config: VerifyConfig = DEFAULT, report: Report | None = None) -> Verification:
    """Find all problems of a data set; nothing is changed.

    Args:
        folder: Folder of demonstrations. Its `failed` episodes and its object cache are checked too.
        config: How thoroughly to verify.
        report: Called with episodes done, episodes in all, and the current stage.

    Returns:
        The result.

    Raises:
        DatasetError: There is no data set.
        ConfigError: The assets are a function that is missing or fails.
        WorkerError: A worker died.
    """
    folder = as_path(folder)
    if config.assets is not None and is_code(config.assets):
        load_assets(config.assets)
    check_failed(folder)
    found = _verify(folder, folder, config, report)
    failed = folder / FAILED_FOLDER
    if (failed / MANIFEST_NAME).is_file() or any(failed.glob("*.arrow")):
        found = found.joined(_verify(failed, folder, config, report))
    return found


def _verify(folder: Path, root: Path, config: VerifyConfig, report: Report | None) -> Verification:
    inventory = take_inventory(folder)
    tasks = _tasks(inventory, root)
    results = dict(_checked(tasks, config, report))
    found = [results[task.path.name] for task in tasks]
    replayed = replay(inventory, results, config, report)
    num_cache_files, cache_problems = check_cache(folder, _joint_hashes(found), config.workers, report)
    own = [*inventory.problems, *_whole_faults(inventory, found), *replayed.problems, *cache_problems]
    place = "" if folder == root else f"{folder.relative_to(root)}/"
    problems = [Problem(place + problem.file, problem.cause, problem.remedy) for problem in own]
    problems += [problem for findings in found for problem in findings.problems]
    return Verification(
        folder=root,
        problems=tuple(sorted(problems)),
        notes=(*inventory.notes, *replayed.notes),
        num_shards=len(tasks),
        num_episodes=sum(findings.num_episodes for findings in found),
        num_replayed=replayed.num_episodes,
        num_cache_files=num_cache_files,
        damaged=tuple(place + task.path.name for task in tasks if results[task.path.name].is_damaged),
    )


def _checked(
    tasks: Sequence[ShardTask], config: VerifyConfig, report: Report | None
) -> Iterator[tuple[str, ShardFindings]]:
    """Yield the name of each shard with its findings."""
    total = sum(0 if task.index is None else task.index.num_rows for task in tasks)
    watch = None if report is None else (lambda done: report(done, max(done, total), "comparing"))
    for task, findings in imap_unordered(check_shard, tasks, config.workers, report=watch):
        yield task.path.name, findings


def _joint_hashes(found: Sequence[ShardFindings]) -> dict[str, str]:
    """Name of each whole shard to the joint hash of its episodes."""
    summaries = [f.summary for f in found if f.summary is not None and not f.is_damaged]
    return {summary.name: joint_hash(summary.index.column("content_hash")) for summary in summaries}


def _tasks(inventory: Inventory, root: Path) -> list[ShardTask]:
    manifest, parts = inventory.manifest, inventory.index_parts()
    generated = manifest if manifest is not None and inventory.is_generated else {}
    return [
        ShardTask(
            path=inventory.folder / name,
            label=str((inventory.folder / name).relative_to(root)),
            entry=None if manifest is None else manifest["shards"][name],
            index=None if inventory.index is None else parts.get(name, inventory.index.slice(0, 0)),
            config=generated.get("config", {}),
            versions=generated.get("versions", {}),
            is_failed=inventory.holds_failed,
            remedy=inventory.remedy,
        )
        for name in inventory.shard_names()
    ]


def _whole_faults(inventory: Inventory, found: Sequence[ShardFindings]) -> Iterator[Problem]:
    """Yield problems of index and manifest that contradict whole shards."""
    summaries = [findings.summary for findings in found if findings.summary is not None]
    yield from _duplicates(summaries)
    manifest = inventory.manifest
    if manifest is None or len(summaries) < len(found):
        return
    index, expected = compose(summaries, {})
    for key, value in expected.items():
        if key != "shards" and manifest[key] != value:  # those were compared one by one
            yield Problem(MANIFEST_NAME, f"{key!r} is not what the shards say", inventory.remedy)
    if inventory.index is not None and not inventory.index.combine_chunks().equals(index):
        cause = "it does not list what the shards hold, or not in this order"
        yield Problem(INDEX_NAME, cause, inventory.remedy)


def _duplicates(summaries: Sequence[ShardSummary]) -> Iterator[Problem]:
    """Yield shards with episodes that occur twice."""
    first: dict[str, str] = {}
    for summary in summaries:
        duplicates = []
        for content_hash in summary.index.column("content_hash").to_pylist():
            if content_hash in first:
                duplicates.append(content_hash)
            first.setdefault(content_hash, summary.name)
        if duplicates:
            cause = f"{len(duplicates)} of its {summary.index.num_rows} episodes are there twice, "
            cause += f"the first of them also in {first[duplicates[0]]}"
            yield Problem(summary.name, cause, "Take one away, and repeat the command that wrote the folder.")
