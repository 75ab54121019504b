"""Generating demonstrations: what a folder holds already, the rollouts, the finished data set."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from openvima.data.encoding import SkipKind, Skipped
from openvima.data.manifest import fill_folder
from openvima.data.planning import COMMAND, DOMAIN, GenerateConfig, OracleBlock, plan
from openvima.data.records import Demonstration, make_env, rollout_oracle
from openvima.data.shard import Shard, ShardWriter, remedy
from openvima.env import TabletopEnv
from openvima.errors import DatasetError, OracleError, SamplingError
from openvima.multiprocess import Report, imap_with_engine


def is_done(block: OracleBlock) -> bool:
    """Say whether a block's shard needs no work.

    A shard is whole if its name exists. It is written again if more episodes are asked for than when it was
    written.
    """
    return block.path.is_file() and len(Shard(block.path)) == block.episodes


def write_block(block: OracleBlock, count: Callable[[int], None]) -> None:
    """Write one shard; a smaller one that is there is continued.

    Args:
        block: What to write.
        count: Called with the number of episodes written so far.

    Raises:
        OracleError: The oracle solved too few of the block's episodes.
        DatasetError: A record that is to be copied is damaged.
    """
    num_kept, next_seed, skipped, reason = 0, block.seeds.start, [], ""
    env = make_env(block.info.task, block.info.level, DOMAIN, block.env_config)
    with ShardWriter(block.path, block.info) as kept:
        if block.path.is_file():
            num_kept, next_seed = _copy_records(block.path, kept)
        for seed in range(next_seed, block.seeds.stop):
            rollout = attempt(env, seed)
            if isinstance(rollout, Skipped):
                skipped.append(rollout)
                reason = rollout.reason
            else:
                kept.write(rollout, skipped)
                num_kept, skipped = num_kept + 1, []
            count(num_kept)
            if num_kept == block.episodes:
                return
        raise OracleError(
            f"the oracle solved {num_kept} of {len(block.seeds)} episodes of {block.info.task!r} at level "
            f"{block.info.level}, {block.episodes} were needed; the last one failed: {reason}."
        )


def _copy_records(path: Path, writer: ShardWriter) -> tuple[int, int]:
    """Copy the records that a shard has already; return their number, and the seed to go on with.

    Raises:
        DatasetError: One is damaged.
    """
    shard, next_seed = Shard(path), 0
    for row in range(len(shard)):
        batch, demo = shard.batch(row), shard[row]
        if demo.content_hash() != batch.column("content_hash")[0].as_py():
            raise DatasetError(f"{path}: record {row} is damaged. {remedy(path.parent)}")
        writer.copy(batch)
        next_seed = demo.seed + 1
    return len(shard), next_seed


def attempt(env: TabletopEnv, seed: int) -> Demonstration | Skipped:
    """Roll out one episode; return the reason if it gives no demonstration."""
    try:
        demo = rollout_oracle(env, seed)
    except SamplingError as error:
        return Skipped(seed, "not_sampled", str(error))
    except OracleError as error:
        return Skipped(seed, "no_action", str(error))
    if demo.outcome.success:
        return demo
    kind: SkipKind = "failed" if demo.outcome.failure else "unsolved"
    return Skipped(seed, kind, demo.outcome.reason or f"not solved in {demo.num_steps} steps")


def generate(config: GenerateConfig, report: Report | None = None) -> Path:
    """Write demonstrations by the oracle, or those that a data folder still lacks.

    Args:
        config: What to generate.
        report: Called with episodes written, those that were there included, episodes in all, and "".

    Returns:
        The folder: shards and, once all are there, `index.parquet` and `dataset.json`. Its bytes depend on
        the settings and versions alone, not on who did the work, nor on interruptions.

    Raises:
        UnknownTaskError, ConfigError: The settings do not fit.
        MissingExtraError: Ray was asked for and is not installed.
        DatasetError: The folder holds a data set of other settings or versions, or a larger one.
        DatasetError: A shard in the folder is damaged.
        StorageError: The disk is full, or the folder cannot be written to.
        OSError: `out` cannot be a folder, as where a file has that name.
        FolderLockedError: Another process writes to the folder, or to the same shards of it.
        WorkerError: A worker died.
        OracleError: The oracle solved too few episodes.
    """
    if config.engine == "ray":  # its workers have other working directories
        config = replace(config, out=config.out.absolute())
    blocks = plan(config)
    fill_folder(
        config.out,
        COMMAND,
        blocks,
        is_done=is_done,
        write=lambda missing, count: imap_with_engine(
            config.engine, write_block, missing, config.workers, address=config.address, report=count
        ),
        settings=config.record,
        shard_range=config.shard_range,
        force=config.force,
        report=report,
    )
    return config.out
