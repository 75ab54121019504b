"""Writing data sets: oracle demonstrations by many processes, the same bytes whatever their number."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from openvima.atomic_io import FINISH_S, folder_lock, parts_in_range
from openvima.data.checksums import spans_of
from openvima.data.manifest import FAILED_FOLDER, ShardSummary, finish_folder, previous_summaries, set_aside
from openvima.data.oracle_rollouts import write_block
from openvima.data.planning import COMMAND, Block, GenerateConfig, plan
from openvima.data.progress import NUM_COUNTS, Report, reporter
from openvima.data.resuming import (
    check_folder,
    clear,
    is_done,
    is_finished,
    remove_leftovers,
    storage_error,
)
from openvima.errors import DatasetError
from openvima.multiprocess import Counts, imap_with_progress


def generate(config: GenerateConfig, report: Report | None = None) -> Path:
    """Write demonstrations by the oracle, or those that a data folder still lacks.

    Args:
        config: What to generate.
        report: Called now and then with how far it is.

    Returns:
        The folder: shards and, once all are there, `index.parquet` and `dataset.json`. Its bytes depend on
        the settings and versions alone, not on who did the work, nor on interruptions.

    Raises:
        UnknownTaskError, LevelError, ConfigError: The settings do not fit.
        MissingExtraError: Ray was asked for and is not installed.
        DatasetError: The folder holds a data set of other settings or versions, or a larger one.
        ShardError: A shard in the folder is damaged.
        StorageError: The disk is full, or the folder cannot be written to.
        OSError: `out` cannot be a folder, as where a file has that name.
        FolderLockedError: Another process writes to the folder, or to the same shards of it.
        WorkerError: A worker died.
        OracleError: The oracle solved too few episodes.
    """
    if config.engine == "ray":  # its workers have other working directories
        config = replace(config, out=config.out.absolute())
    blocks = plan(config)
    own = blocks if config.shard_range is None else parts_in_range(blocks, config.shard_range)
    config.out.mkdir(parents=True, exist_ok=True)
    try:
        with folder_lock(config.out, config.shard_range):
            if config.force:
                clear(config.out)
            check_folder(config, blocks)
            _write_missing(config, own, report)
            if config.shard_range is None and not is_finished(config.out):
                finish(config, blocks)
        if config.shard_range is not None:
            _finish_with_others(config, blocks)
    except BrokenPipeError:  # of `report`
        raise
    except OSError as error:
        raise storage_error(config.out, [block.path for block in blocks], error) from error
    return config.out


def _write_missing(config: GenerateConfig, own: Sequence[Block], report: Report | None) -> None:
    """Write those shards of this run that are not there.

    Raises:
        DatasetError: A shard is not where it should be.
    """
    _remove_leftovers(config, own)
    missing = [block for block in own if not is_done(block)]
    previous = previous_summaries(config.out) if missing and not config.keep_failed else {}
    missing = [_with_kept(block, previous.get(block.path.name)) for block in missing]
    missing.sort(key=lambda block: -block.episodes)  # small ones then fill the gaps at the end
    watch = reporter(report, own, missing)
    if not missing:
        return
    for folder in (config.out, config.out / FAILED_FOLDER):
        set_aside(folder)  # a manifest speaks of whole data sets
    try:
        for _ in _engine(config, missing, watch):
            pass  # a block's result is its file
    finally:
        _remove_leftovers(config, own)
    lost = [block.path for block in own if not block.path.is_file()]
    if lost:
        raise DatasetError(
            f"{lost[0]} was written on another machine and is not to be seen on this one. "
            "Give an --out that all machines of the cluster share."
        )


def _remove_leftovers(config: GenerateConfig, own: Sequence[Block]) -> None:
    remove_leftovers(config.out, None if config.shard_range is None else [block.path for block in own])


def _engine(
    config: GenerateConfig, missing: Sequence[Block], watch: Callable[[Counts], None]
) -> Iterator[tuple[Block, None]]:
    if config.engine == "processes":
        num_workers = config.workers or 1
        return imap_with_progress(write_block, missing, num_workers, num_counts=NUM_COUNTS, watch=watch)
    from openvima.multiprocess import ray_imap_unordered

    num_workers = config.workers or (1 if config.address is None else None)
    return ray_imap_unordered(
        write_block, missing, num_workers, address=config.address, num_counts=NUM_COUNTS, watch=watch
    )


def _finish_with_others(config: GenerateConfig, blocks: Sequence[Block]) -> None:
    """Write index and manifest if the shards of all ranges are there."""
    if is_finished(config.out) or not all(is_done(block) for block in blocks):
        return
    with folder_lock(config.out, timeout_s=FINISH_S):  # others may have come to the same conclusion
        if not is_finished(config.out):
            finish(config, blocks)


def _with_kept(block: Block, summary: ShardSummary | None) -> Block:
    """Add the records that a smaller shard has already."""
    return block if summary is None else replace(block, kept=tuple(spans_of(summary.index)))


def finish(config: GenerateConfig, blocks: Sequence[Block], *, reuse: bool = True) -> None:
    """Write index and manifest of a folder whose shards are all there, and those of its failed episodes.

    Args:
        config: What was generated.
        blocks: Its division into shards.
        reuse: Trust what the previous manifest says of shards that it fits, instead of reading them.

    Raises:
        ShardError: A shard is damaged.
    """
    versions, record = blocks[0].info.versions, config.record()
    failed = [block.failed_path for block in blocks if block.failed_path and block.failed_path.is_file()]
    if failed:
        settings = {**record, "kept": FAILED_FOLDER}
        finish_folder(config.out / FAILED_FOLDER, failed, command=COMMAND, config=settings, versions=versions)
    paths = [block.path for block in blocks]
    known = previous_summaries(config.out) if reuse else {}
    finish_folder(config.out, paths, command=COMMAND, config=record, versions=versions, known=known)
