"""Generating demonstrations: what to generate, its division into shards, the rollouts, the finished data set.

The division depends on the settings alone. Shards of a task are numbered. The size of a shard and its range
of seeds follow from its number, so that a data set of more episodes begins with the very shards of a smaller
one: asking for more extends it.
"""

import itertools
import shlex
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from openvima.catalog.packs import load_assets
from openvima.catalog.partitions import LEVELS
from openvima.data.encoding import ShardInfo, SkipKind, Skipped
from openvima.data.manifest import Block, fill_folder
from openvima.data.records import Demonstration, make_env, package_versions, rollout_oracle
from openvima.data.shard import Shard, ShardWriter, remedy
from openvima.env.config import DEFAULT_ENV_CONFIG, ENV_SETTINGS, EnvConfig
from openvima.errors import ConfigError, DatasetError, OracleError, SamplingError, brief_repr, unknown_name
from openvima.input_files import settle
from openvima.multiprocess import MAX_WORKERS, Report, engine_problems, imap_with_engine
from openvima.tasks import list_tasks, task_spec
from openvima.tasks.registry import named_tasks
from openvima.tasks.sampling import MAX_SEED, check_task_options, check_text_form, takes_prompts

if TYPE_CHECKING:  # comes with the simulator
    from openvima.env import TabletopEnv

Engine = Literal["processes", "ray"]
Compression = Literal["lz4", "zstd"]

COMMAND = "openvima generate"  # what manifests name as their maker
DOMAIN = "train"
LARGEST_SHARD = 1000  # episodes, about 44 MB
SMALLEST_SHARD = 4
# So many shards of a size, then the size doubles: a small data set has work for several processes, and a
# large one few files.
SHARDS_OF_A_SIZE = 4
# A shard may try this many seeds for each episode that it needs, and some more; a task of which the oracle
# solves so few needs repair rather than patience.
SEEDS_PER_EPISODE = 4
SPARE_SEEDS = 12
MAX_EPISODES = 10**7  # of a task, in one folder
MAX_FIRST_SEED = MAX_SEED - 10**9  # leaves room for the seeds of all shards


@dataclass(frozen=True, slots=True)
class GenerateConfig:
    """What to generate, where, and how.

    Args:
        out: The folder.
        tasks: Names of the tasks; ("all",) means all that the level has, and with text prompts a
            text form; "heldout" the four that are held out for L4.
        episodes: Successful episodes of each task.
        level: one of `openvima.catalog.LEVELS`.
        start_seed: First seed.
        shard_size: Episodes in a file; None lets files grow with their number, from 4 episodes to 1,000.
        env_config: Settings of the environments.
        compression: Codec of the files: "lz4", or "zstd", which is smaller and slower.
        images: Store images; without, they are drawn anew on reading.
        workers: Number of processes; None means one, or on a Ray cluster at an address all that it offers.
        engine: "processes" of this machine, or "ray".
        address: Of a Ray cluster; None starts Ray on this machine for as long as it is needed.
        shard_range: First and past-the-end position in `plan(config)` of the shards to write; None
            means all of them.
        force: Delete a data set that is in the folder.

    Raises:
        ConfigError: A number is out of its range, or settings contradict each other.
    """

    out: Path
    tasks: tuple[str, ...] = ("all",)
    episodes: int = 100
    level: str = "train"
    start_seed: int = 0
    shard_size: int | None = None
    env_config: EnvConfig = DEFAULT_ENV_CONFIG
    compression: Compression = "lz4"
    images: bool = True
    workers: int | None = None
    engine: Engine = "processes"
    address: str | None = None
    shard_range: tuple[int, int] | None = None
    force: bool = False

    __repr__ = brief_repr

    def __post_init__(self) -> None:
        settle(self, paths=("out",), names=("tasks",))
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
        problems += engine_problems(self.engine, self.address)
        if self.shard_range is not None:
            start, stop = self.shard_range
            if not 0 <= start < stop:
                problems.append(f"shard_range is {start}:{stop}; it must be a:b with 0 ≤ a < b.")
            if self.force:
                problems.append(
                    "force and shard_range exclude each other: each part would delete those before it."
                )
        if problems:
            raise ConfigError(" ".join(problems))

    def resolved_tasks(self) -> tuple[str, ...]:
        """Return the names of the tasks, sorted.

        Raises:
            UnknownTaskError: There is no such task.
            ConfigError: There is no such level, or a task is not defined at it.
            ConfigError: A named task has no text form, which the prompts need; "all" leaves it out. Or a task
                option does not fit.
        """
        if self.level not in LEVELS:
            raise ConfigError(unknown_name("level", self.level, LEVELS))
        if self.tasks == ("all",):
            there = (task for task in list_tasks() if self.level in task_spec(task).levels)
            tasks = tuple(sorted(task for task in there if takes_prompts(task, self.env_config.prompts)))
        else:
            tasks = tuple(sorted(named_tasks(self.tasks)))
            for task in tasks:
                task_spec(task).pool(self.level)
                check_text_form(task, self.env_config.prompts)
        check_task_options(tasks, self.env_config.task_options)
        return tasks

    def record(self) -> dict[str, Any]:
        """Return the settings that decide the content, as the manifest holds them: no path, no machine."""
        return {
            "tasks": list(self.resolved_tasks()),
            "level": self.level,
            "domain": DOMAIN,
            "episodes": self.episodes,
            "start_seed": self.start_seed,
            "shard_size": self.shard_size or 0,
            "compression": self.compression,
            "images": self.images,
            **self.env_config.record(),
        }


def generate_command(out: Path, record: Mapping[str, Any]) -> str:
    """Return the command that writes a data set, or what a folder lacks of it.

    Args:
        out: The folder.
        record: `config` of its manifest.
    """
    words = [*COMMAND.split(), "--out", str(out)]
    for name in ("tasks", "episodes", "level", "compression", "start_seed", "shard_size", *ENV_SETTINGS):
        option, value = f"--{name.removeprefix('start_').replace('_', '-')}", record.get(name)
        if value is True:
            words.append(option)
        elif value:
            words += [option, ",".join(map(str, value)) if isinstance(value, list) else str(value)]
    if not record.get("images", True):
        words.append("--no-images")
    return shlex.join(words)


@dataclass(frozen=True, slots=True)
class OracleBlock(Block):
    """A shard with so many episodes out of a range of seeds of its own.

    Args:
        seeds: Seeds to try, in order.
        env_config: As in `GenerateConfig`.
    """

    seeds: range
    env_config: EnvConfig


def plan(config: GenerateConfig) -> list[OracleBlock]:
    """Divide the work into blocks.

    Args:
        config: What to generate; its `shard_range` is not applied.

    Returns:
        One block a shard, by task and number. They depend on what is asked for, not on who does it.
    """
    versions, assets = package_versions(), load_assets(config.env_config.assets).name
    blocks = []
    for task in config.resolved_tasks():
        for number, episodes, seeds in _divide(config):
            info = ShardInfo(
                task=task,
                level=config.level,
                domain=DOMAIN,
                number=number,
                shard_size=config.shard_size or 0,
                first_seed=config.start_seed,
                versions=versions,
                compression=config.compression,
                images=config.images,
                **{**asdict(config.env_config), "assets": assets},
            )
            blocks.append(OracleBlock(config.out / info.file_name, info, episodes, seeds, config.env_config))
    return blocks


def shard_episodes(number: int, shard_size: int | None = None) -> int:
    """Return how many episodes a full shard holds.

    Args:
        number: Which shard of its task, from 0.
        shard_size: Size of all shards; None lets them grow with their number.

    Example:
        >>> [shard_episodes(number) for number in (0, 3, 4, 8, 31, 32, 99)]
        [4, 4, 8, 16, 512, 1000, 1000]
    """
    doublings = min(number // SHARDS_OF_A_SIZE, LARGEST_SHARD.bit_length())
    return shard_size or min(LARGEST_SHARD, SMALLEST_SHARD << doublings)


def _divide(config: GenerateConfig) -> Iterator[tuple[int, int, range]]:
    """Yield number, episodes and seeds of each shard of a task; the last may be smaller than a full one."""
    first, num_left = config.start_seed, config.episodes
    for number in itertools.count():
        size = shard_episodes(number, config.shard_size)
        episodes = min(size, num_left)
        yield number, episodes, range(first, first + _num_seeds(episodes))
        first, num_left = first + _num_seeds(size), num_left - size
        if num_left <= 0:
            return


def _num_seeds(episodes: int) -> int:
    return SEEDS_PER_EPISODE * episodes + SPARE_SEEDS


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


def attempt(env: "TabletopEnv", seed: int) -> Demonstration | Skipped:
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
