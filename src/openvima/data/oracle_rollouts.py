"""Rolling out the oracle for one shard and writing the episodes; the work of one process."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache

from openvima.data.encoding import SkipKind, Skipped
from openvima.data.planning import DOMAIN, Block
from openvima.data.records import Demonstration, rollout_oracle
from openvima.data.shard import Shard
from openvima.data.writer import ShardWriter
from openvima.env import TabletopEnv
from openvima.env.config import EnvConfig
from openvima.errors import OracleError, SamplingError


def write_block(block: Block, count: Callable[[int, int, int], None]) -> None:
    """Write one shard, and one of its failed episodes if these are kept.

    Args:
        block: What to write.
        count: Called with the numbers of episodes written, seeds tried, and redraws so far.

    Raises:
        OracleError: The oracle solved too few of the block's episodes.
        ShardError: A record that is to be copied is damaged.
    """
    num_kept, num_redraws, skipped = 0, 0, []
    with contextlib.ExitStack() as files:  # closed in reverse: where a shard is, its failed episodes are too
        kept = files.enter_context(ShardWriter(block.path, block.info))
        failed: ShardWriter | None = None
        if block.kept:
            num_kept, next_seed = len(block.kept), _copy_kept(block, kept)
            rest = range(next_seed, block.seeds.stop)
            block = replace(block, episodes=block.episodes - num_kept, seeds=rest)
        for num_tried, rollout in enumerate(rollouts(block), start=1):
            if isinstance(rollout, Skipped):
                skipped.append(rollout)
            elif rollout.outcome.success:
                kept.write(rollout, skipped)
                num_kept, skipped = num_kept + 1, []
            else:
                skipped.append(why_skipped(rollout))
                if block.failed_path is not None:
                    if failed is None:
                        block.failed_path.parent.mkdir(exist_ok=True)
                        failed = files.enter_context(ShardWriter(block.failed_path, block.info))
                    failed.write(rollout)
            num_redraws += 0 if isinstance(rollout, Skipped) else rollout.num_redraws
            count(num_kept, num_tried, num_redraws)


def _copy_kept(block: Block, writer: ShardWriter) -> int:
    """Copy the records that a shard has already; return the seed to go on with.

    Raises:
        ShardError: One is damaged.
    """
    shard = Shard(block.path)
    for row, span in enumerate(block.kept):
        shard.check(row, span)
        writer.copy(shard.batch(row))
    return shard.read(len(block.kept) - 1, ["seed"])["seed"] + 1


def rollouts(block: Block) -> Iterator[Demonstration | Skipped]:
    """Roll out seeds until enough of them are solved.

    Args:
        block: Its seeds and number of episodes.

    Yields:
        The result of `attempt` for each seed; the last one is solved.

    Raises:
        OracleError: The seeds ran out.
    """
    env = _env(block.info.task, block.info.level, block.env_config)
    num_solved, reason = 0, ""
    for seed in block.seeds:
        rollout = attempt(env, seed)
        yield rollout
        if isinstance(rollout, Skipped) or not rollout.outcome.success:
            reason = (rollout if isinstance(rollout, Skipped) else why_skipped(rollout)).reason
            continue
        num_solved += 1
        if num_solved == block.episodes:
            return
    raise OracleError(
        f"the oracle solved {num_solved} of {len(block.seeds)} episodes of {block.info.task!r} at level "
        f"{block.info.level}, {block.episodes} were needed; the last one failed: {reason}."
    )


def attempt(env: TabletopEnv, seed: int) -> Demonstration | Skipped:
    """Roll out one episode, solved or not; return the reason if there is none."""
    try:
        return rollout_oracle(env, seed)
    except SamplingError as error:
        return Skipped(seed, "not_sampled", str(error))
    except OracleError as error:
        return Skipped(seed, "no_action", str(error))


def why_skipped(demo: Demonstration) -> Skipped:
    """Return the reason why an unsolved episode is skipped."""
    kind: SkipKind = "failed" if demo.outcome.failure else "unsolved"
    return Skipped(demo.seed, kind, demo.outcome.reason or f"not solved in {demo.num_steps} steps")


@lru_cache(maxsize=4)
def _env(task: str, level: str, env_config: EnvConfig) -> TabletopEnv:
    return env_config.make(task, level, domain=DOMAIN)
