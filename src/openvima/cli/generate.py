"""`openvima generate`: write demonstrations with the oracle."""

import sys
from pathlib import Path

from openvima.cli.progress import progress_bar


def main(
    *,
    out: Path,
    tasks: str = "all",
    episodes: int = 100,
    level: str = "train",
    workers: int = 1,
    seed: int = 0,
    shard_size: int | None = None,
    assets: str = "procedural",
    compat: bool = False,
    difficulty: str = "easy",
    force: bool = False,
) -> int:
    """Write demonstrations with the oracle, or those that a folder still lacks.

    The same settings give the same bytes, whatever the number of workers; repeating a command that was
    interrupted continues it.

    Example: openvima generate --tasks rotate,visual_manipulation --episodes 1000 --workers 2 --out demos

    Args:
        out: Folder to write to.
        tasks: Names of tasks with commas between them, or "all".
        episodes: Successful episodes of each task.
        level: Which objects and textures may occur: train, L1, L2, L3 or L4.
        workers: Number of processes.
        seed: First seed.
        shard_size: Episodes in a file; by default an eighth of them, but 4 to 1000. Give it to be able
            to ask for more episodes later.
        assets: procedural, original (see `openvima assets import`), or a checkout of the original benchmark.
        compat: Follow the original benchmark also where it is odd; docs/compat.md lists the differences.
        difficulty: easy, as for all published results, medium or hard.
        force: Delete the data set that is in the folder.
    """
    from openvima.data import GenerateConfig, generate
    from openvima.env import Setup

    config = GenerateConfig(
        out=out,
        tasks=tuple(name.strip() for name in tasks.split(",") if name.strip()),
        episodes=episodes,
        level=level,
        start_seed=seed,
        shard_size=shard_size,
        workers=workers,
        setup=Setup(assets, compat, difficulty),
        force=force,
    )
    with progress_bar("demonstrations") as report:
        folder = generate(config, report)
    print(f"`openvima data info {folder}` shows what is there.", file=sys.stderr)
    print(folder)
    return 0
