"""Writing data sets: oracle demonstrations by several processes, the same bytes whatever their number."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from openvima.catalog.packs import load_assets
from openvima.data.encoding import ShardInfo, SkipKind, Skipped
from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME, finish_folder
from openvima.data.reader import Shard
from openvima.data.records import Demonstration, package_versions, rollout_oracle
from openvima.data.writer import ShardWriter, remove_leftovers
from openvima.env import TabletopEnv
from openvima.env.setup import DEFAULT_SETUP, Setup
from openvima.errors import ConfigError, DatasetError, OracleError, SamplingError
from openvima.processes import in_processes
from openvima.tasks import list_tasks, task_spec
from openvima.tasks.seeding import MAX_SEED

DOMAIN = "train"
LARGEST_SHARD = 1000  # episodes, about 25 MB
SMALLEST_SHARD = 4
SHARDS_PER_TASK = 8  # of a small data set, so that several workers have something to do
# A shard may try this many seeds for each episode that it needs, and some more; a task of which the oracle
# solves so few needs repair rather than patience.
SEEDS_PER_EPISODE = 4
SPARE_SEEDS = 12
MAX_EPISODES = 10**7  # of a task, in one folder
MAX_WORKERS = 1024
MAX_FIRST_SEED = MAX_SEED - 10**9  # leaves room for the seeds of all shards

Report = Callable[[int, int, str], None]


@dataclass(frozen=True, slots=True)
class GenerateConfig:
    """What to generate, and where.

    Args:
        out: The folder.
        tasks: Names of the tasks; ("all",) means all that the level has.
        episodes: Successful episodes of each task.
        level: "train" or "L1" to "L4".
        start_seed: First seed.
        shard_size: Episodes in a file; None chooses an eighth of `episodes`, but 4 … 1,000.
        workers: Number of processes.
        setup: Assets, difficulty, and whether to follow the original benchmark where it is odd.
        force: Delete a data set that is in the folder.
    """

    out: Path
    tasks: tuple[str, ...] = ("all",)
    episodes: int = 100
    level: str = "train"
    start_seed: int = 0
    shard_size: int | None = None
    workers: int = 1
    setup: Setup = DEFAULT_SETUP
    force: bool = False

    def __post_init__(self) -> None:
        problems = [
            f"{name} is {value}; it must lie within {least} … {most}."
            for name, value, least, most in (
                ("episodes", self.episodes, 1, MAX_EPISODES),
                ("seed", self.start_seed, 0, MAX_FIRST_SEED),
                ("shard_size", self.shard_size, 1, MAX_EPISODES),
                ("workers", self.workers, 1, MAX_WORKERS),
            )
            if value is not None and not least <= value <= most
        ]
        if not self.tasks:
            problems.append("tasks is empty; name some, or 'all'.")
        if problems:
            raise ConfigError(" ".join(problems))

    def resolved_tasks(self) -> tuple[str, ...]:
        """Return the names of the tasks, sorted.

        Raises:
            UnknownTaskError: There is no such task.
            LevelError: A task is not defined at the level.
        """
        if self.tasks == ("all",):
            return tuple(sorted(task for task in list_tasks() if self.level in task_spec(task).levels))
        for task in self.tasks:
            task_spec(task).pool(self.level)
        return tuple(sorted(set(self.tasks)))

    def resolved_shard_size(self) -> int:
        """Return the number of episodes in a full shard."""
        eighth = -(-self.episodes // SHARDS_PER_TASK)
        return self.shard_size or min(LARGEST_SHARD, max(SMALLEST_SHARD, eighth))


@dataclass(frozen=True, slots=True)
class Block:
    """One shard to be written: so many episodes out of a range of seeds of its own.

    Args:
        path: The file.
        info: What all its rows have in common.
        episodes: Number of successful episodes.
        seeds: Seeds to try, in order.
        setup: As in `GenerateConfig`.
    """

    path: Path
    info: ShardInfo
    episodes: int
    seeds: range
    setup: Setup


def generate(config: GenerateConfig, report: Report | None = None) -> Path:
    """Write demonstrations by the oracle, or those that a data folder still lacks.

    Args:
        config: What to generate.
        report: Called with episodes done, episodes in all, and a note.

    Returns:
        The folder: shards, `index.parquet` and `dataset.json`. Its bytes depend on the settings and versions
        alone, not on the number of workers or on interruptions.

    Raises:
        UnknownTaskError, LevelError, ConfigError: The settings do not fit.
        DatasetError: The folder holds a data set of other settings or versions.
        WorkerError: A worker died. Whole shards are kept, and the same command goes on from there.
        OracleError: The oracle solved too few episodes.
    """
    blocks = plan(config)
    config.out.mkdir(parents=True, exist_ok=True)
    if config.force:
        _clear(config.out)
    _check_folder(config, blocks)
    missing = [block for block in blocks if not _is_done(block)]
    num_done = sum(block.episodes for block in blocks) - sum(block.episodes for block in missing)
    try:
        for _ in in_processes(
            write_block, missing, config.workers, report=_shifted(report, num_done, blocks)
        ):
            pass  # a block's result is its file
    finally:
        remove_leftovers(config.out)
    if missing or not (config.out / MANIFEST_NAME).is_file():
        finish(config, blocks)
    return config.out


def plan(config: GenerateConfig) -> list[Block]:
    """Divide the work into blocks; the division depends on the settings alone."""
    size, versions = config.resolved_shard_size(), package_versions()
    stride = SEEDS_PER_EPISODE * size + SPARE_SEEDS
    assets = load_assets(config.setup.assets).name
    blocks = []
    for task in config.resolved_tasks():
        for number, start in enumerate(range(0, config.episodes, size)):
            first = config.start_seed + number * stride
            blocks.append(
                Block(
                    path=config.out / f"{task}-{config.level}-{number:05d}.arrow",
                    info=ShardInfo(
                        task=task,
                        level=config.level,
                        domain=DOMAIN,
                        number=number,
                        shard_size=size,
                        first_seed=config.start_seed,
                        assets=assets,
                        versions=versions,
                        compat=config.setup.compat,
                        difficulty=config.setup.difficulty,
                    ),
                    episodes=min(size, config.episodes - start),
                    seeds=range(first, first + stride),
                    setup=config.setup,
                )
            )
    return blocks


def write_block(block: Block, count: Callable[[int], None]) -> None:
    """Write one shard.

    Args:
        block: What to write.
        count: Called with the number of episodes written so far.

    Raises:
        OracleError: The oracle solved too few of the block's episodes.
    """
    with ShardWriter(block.path, block.info) as writer:
        for number, (demo, skipped) in enumerate(demonstrations(block), start=1):
            writer.write(demo, skipped)
            count(number)


def demonstrations(block: Block) -> Iterator[tuple[Demonstration, list[Skipped]]]:
    """Yield the successful demonstrations of a block, each with the seeds tried in vain before it.

    Raises:
        OracleError: The seeds ran out.
    """
    env = _env(block.info.task, block.info.level, block.setup)
    num_found, skipped = 0, []
    for seed in block.seeds:
        demo = attempt(env, seed)
        if isinstance(demo, Skipped):
            skipped.append(demo)
            continue
        yield demo, skipped
        num_found, skipped = num_found + 1, []
        if num_found == block.episodes:
            return
    raise OracleError(
        f"the oracle solved {num_found} of {len(block.seeds)} episodes of {block.info.task!r} at level "
        f"{block.info.level}, {block.episodes} were needed; the last one failed: {skipped[-1].reason}."
    )


def attempt(env: TabletopEnv, seed: int) -> Demonstration | Skipped:
    """Let the oracle play one episode; say why if that gives no demonstration."""
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


def finish(config: GenerateConfig, blocks: Sequence[Block]) -> None:
    """Write index and manifest of a folder whose shards are all there."""
    settings = {
        "tasks": list(config.resolved_tasks()),
        "level": config.level,
        "domain": DOMAIN,
        "episodes": config.episodes,
        "start_seed": config.start_seed,
        "shard_size": config.resolved_shard_size(),
        "assets": blocks[0].info.assets,
        "compat": config.setup.compat,
        "difficulty": config.setup.difficulty,
    }
    finish_folder(
        config.out,
        [block.path for block in blocks],
        command="openvima generate",
        config=settings,
        versions=blocks[0].info.versions,
    )


@lru_cache(maxsize=4)
def _env(task: str, level: str, setup: Setup) -> TabletopEnv:
    return setup.make(task, level, domain=DOMAIN)


def _is_done(block: Block) -> bool:
    """A shard is done if its name exists, unless fewer episodes were asked for when it was written."""
    return block.path.is_file() and len(Shard(block.path)) == block.episodes


def _check_folder(config: GenerateConfig, blocks: Sequence[Block]) -> None:
    """Refuse a folder whose shards do not belong to the data set that is asked for."""
    wanted = {block.path.name: block for block in blocks}
    for path in sorted(config.out.glob("*.arrow")):
        block = wanted.get(path.name)
        found = Shard(path)
        problems = _differences(found.info, blocks[0].info)
        if block is None and not problems:
            problems = [f"it is not among the {len(blocks)} shards of {config.episodes} episodes a task"]
        if block is not None and len(found) > block.episodes:
            problems.append(f"it has {len(found)} episodes, asked for are {block.episodes}")
        if problems:
            raise DatasetError(
                f"{path} belongs to another data set: {'; '.join(problems)}. "
                "Give its settings, another --out, or --force to delete it."
            )


def _differences(found: ShardInfo, asked: ShardInfo) -> list[str]:
    names = ("level", "domain", "shard_size", "first_seed", "assets", "compat", "difficulty")
    pairs = [(name, getattr(found, name), getattr(asked, name)) for name in names]
    pairs += [(name, found.versions.get(name), asked.versions[name]) for name in asked.versions]
    return [f"{name} is {there}, asked for is {here}" for name, there, here in pairs if there != here]


def _clear(folder: Path) -> None:
    for path in [folder / MANIFEST_NAME, folder / INDEX_NAME, *folder.glob("*.arrow")]:
        path.unlink(missing_ok=True)
    remove_leftovers(folder)


def _shifted(report: Report | None, num_done: int, blocks: Sequence[Block]) -> Callable[[int], None]:
    total = sum(block.episodes for block in blocks)
    if report is None:
        return lambda count: None
    report(num_done, total, "")
    return lambda count: report(num_done + count, total, "")
