"""`openvima generate`: write demonstrations with the oracle."""

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from openvima.cli.terminal import (
    DEFAULT_ENVIRONMENT,
    Environment,
    parse_list,
    parse_shard_range,
    print_left_out,
    progress_bar,
)


def main(
    *,
    out: Path,
    tasks: str = "all",
    episodes: int = 100,
    level: str = "train",
    workers: int | None = None,
    seed: int = 0,
    shard_size: int | None = None,
    shard_range: str | None = None,
    list_shards: bool = False,
    engine: Literal["processes", "ray"] = "processes",
    address: str | None = None,
    compression: Literal["lz4", "zstd"] = "lz4",
    images: bool = True,
    force: bool = False,
    environment: Environment = DEFAULT_ENVIRONMENT,
) -> None:
    """Write demonstrations with the oracle, or those that a folder still lacks.

    The same settings give the same bytes, whoever does the work; repeating a command that was interrupted
    continues it, and asking for more episodes extends what is there.

    Example: openvima generate --tasks rotate,visual_manipulation --episodes 1000 --workers 2 --out demos

    Args:
        out: Folder to write to.
        tasks: Names of tasks with commas between them, "all", or "heldout" for the four tasks of L4 that
            training does not see.
        episodes: Successful episodes of each task.
        level: Which objects and textures may occur: train, L1 to L8.
        workers: Number of processes; by default one, or all CPUs of the Ray cluster at --address.
        seed: First seed.
        shard_size: Episodes in a file; by default files grow with their number, from 4 episodes to 1000.
        shard_range: Write only these of the shards that --list-shards numbers, as a:b without b itself;
            for job arrays. The data set is finished by whoever finds all shards there.
        list_shards: Print the shards, one a line: number, file, episodes. Write nothing.
        engine: processes of this machine, or ray.
        address: Ray cluster as HOST:PORT; by default Ray is started on this machine and stopped at the end.
        compression: Codec of the files: lz4, or zstd, which is smaller and slower.
        images: Store images; without, they are drawn anew on reading.
        force: Delete the data set that is in the folder.
        environment: Tasks, prompts and control.
    """
    from openvima.data import GenerateConfig, generate, plan
    from openvima.data.manifest import is_finished
    from openvima.env import EnvConfig

    config = GenerateConfig(
        out=out,
        tasks=parse_list(tasks),
        episodes=episodes,
        level=level,
        start_seed=seed,
        shard_size=shard_size,
        env_config=EnvConfig(**asdict(environment)),
        compression=compression,
        images=images,
        workers=workers,
        engine=engine,
        address=address,
        shard_range=parse_shard_range(shard_range),
        force=force,
    )
    print_left_out(config.tasks, environment.prompts, [level])
    if list_shards:
        for number, block in enumerate(plan(config)):
            print(f"{number}\t{block.path.name}\t{block.episodes}")
        return
    with progress_bar("demonstrations") as report:
        folder = generate(config, report)
    if is_finished(folder):
        print(f"`openvima data info {shlex.quote(str(folder))}` shows what is there.", file=sys.stderr)
    else:
        print(f"{folder} is not finished yet: shards of other ranges are missing.", file=sys.stderr)
    print(folder)
