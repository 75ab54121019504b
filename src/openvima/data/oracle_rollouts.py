"""Playing one shard's episodes with the oracle and writing them; what a worker does."""

import contextlib
from collections.abc import Callable, Iterator
from functools import lru_cache

from openvima.data.encoding import SkipKind, Skipped
from openvima.data.planning import DOMAIN, Block
from openvima.data.records import Demonstration, rollout_oracle
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
    """
    num_kept, num_redraws, skipped = 0, 0, []
    with contextlib.ExitStack() as files:  # closed in reverse: where a shard is, its failed episodes are too
        kept = files.enter_context(ShardWriter(block.path, block.info))
        failed: ShardWriter | None = None
        for num_tried, trial in enumerate(trials(block), start=1):
            if isinstance(trial, Skipped):
                skipped.append(trial)
            elif trial.outcome.success:
                kept.write(trial, skipped)
                num_kept, skipped = num_kept + 1, []
            else:
                skipped.append(why_skipped(trial))
                if block.failed_path is not None:
                    if failed is None:
                        block.failed_path.parent.mkdir(exist_ok=True)
                        failed = files.enter_context(ShardWriter(block.failed_path, block.info))
                    failed.write(trial)
            num_redraws += 0 if isinstance(trial, Skipped) else trial.num_redraws
            count(num_kept, num_tried, num_redraws)


def trials(block: Block) -> Iterator[Demonstration | Skipped]:
    """Try seeds until enough of them are solved.

    Args:
        block: Where to look, and how many to find.

    Yields:
        What `attempt` makes of each seed; the last one is solved.

    Raises:
        OracleError: The seeds ran out.
    """
    env = _env(block.info.task, block.info.level, block.env_config)
    num_solved, reason = 0, ""
    for seed in block.seeds:
        trial = attempt(env, seed)
        yield trial
        if isinstance(trial, Skipped) or not trial.outcome.success:
            reason = (trial if isinstance(trial, Skipped) else why_skipped(trial)).reason
            continue
        num_solved += 1
        if num_solved == block.episodes:
            return
    raise OracleError(
        f"the oracle solved {num_solved} of {len(block.seeds)} episodes of {block.info.task!r} at level "
        f"{block.info.level}, {block.episodes} were needed; the last one failed: {reason}."
    )


def attempt(env: TabletopEnv, seed: int) -> Demonstration | Skipped:
    """Let the oracle play one episode, solved or not; say why if there is nothing to show."""
    try:
        return rollout_oracle(env, seed)
    except SamplingError as error:
        return Skipped(seed, "not_sampled", str(error))
    except OracleError as error:
        return Skipped(seed, "no_action", str(error))


def why_skipped(demo: Demonstration) -> Skipped:
    """Say why an episode that was not solved is none to learn from."""
    kind: SkipKind = "failed" if demo.outcome.failure else "unsolved"
    return Skipped(demo.seed, kind, demo.outcome.reason or f"not solved in {demo.num_steps} steps")


@lru_cache(maxsize=4)
def _env(task: str, level: str, env_config: EnvConfig) -> TabletopEnv:
    return env_config.make(task, level, domain=DOMAIN)
