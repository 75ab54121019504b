"""`openvima data sample`, `split` and `merge`: data sets made of others."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from openvima.cli.lists import parse_tasks
from openvima.cli.progress import progress_bar

Compression = Literal["lz4", "zstd"]


def sample(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    *,
    share: float,
    tasks: str = "all",
    seed: int = 0,
    compression: Compression | None = None,
    workers: int = 1,
    force: bool = False,
) -> int:
    """Write a share of the demonstrations of each task.

    Smaller shares of the same seed are part of larger ones: the 1 % is part of the 10 %. Nothing in a
    demonstration is changed.

    Example: openvima data sample demos demos-1-percent --share 0.01

    Args:
        folder: The data set to take from.
        out: Folder to write to.
        share: Above 0, at most 1; at least one episode of each task is taken.
        tasks: Names of tasks with commas between them, or "all".
        seed: Another one gives another choice.
        compression: Codec of the new files; by default that of the data set.
        workers: Number of processes.
        force: Replace the data set that is in the folder.

    Returns:
        Exit status.
    """
    from openvima.data.subsets import SubsetConfig
    from openvima.data.subsets import sample as write_sample

    config = SubsetConfig(folder, out, parse_tasks(tasks), seed, compression, workers, force)
    with progress_bar("demonstrations") as report:
        print(write_sample(config, share, report=report))
    return 0


def split(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    *,
    parts: str,
    tasks: str = "all",
    seed: int = 0,
    compression: Compression | None = None,
    workers: int = 1,
    force: bool = False,
) -> int:
    """Divide demonstrations into parts, such as for training and validation.

    Each episode goes to exactly one part, and stays there when episodes are added; sizes therefore come close
    to the shares without meeting them.

    Example: openvima data split demos divided --parts training=0.923,validation=0.077

    Args:
        folder: The data set to divide.
        out: Folder to write to; it will hold a data set for each part.
        parts: Names and shares, with commas between them; the shares add up to 1.
        tasks: Names of tasks with commas between them, or "all".
        seed: Another one gives another division.
        compression: Codec of the new files; by default that of the data set.
        workers: Number of processes.
        force: Replace the data sets that are in the folder.

    Returns:
        Exit status.
    """
    from openvima.data.subsets import SubsetConfig, parse_parts
    from openvima.data.subsets import split as write_split

    config = SubsetConfig(folder, out, parse_tasks(tasks), seed, compression, workers, force)
    shares = parse_parts(parts)
    with progress_bar("demonstrations") as report:
        written = write_split(config, shares, report=report)
    for name in shares.shares:
        print(written / name)
    return 0


def merge(
    folders: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER… OUT")],
    *,
    tasks: str = "all",
    duplicates: Literal["refuse", "skip"] = "refuse",
    compression: Compression | None = None,
    workers: int = 1,
    force: bool = False,
) -> int:
    """Put data sets together, of whatever tasks, levels, settings and versions.

    Files are copied byte for byte unless another compression is asked for or episodes are skipped.

    Example: openvima data merge rotations stacks all-demos

    Args:
        folders: The data sets to put together, and last the folder to write to.
        tasks: Names of tasks with commas between them, or "all".
        duplicates: What to do with episodes that several data sets hold: refuse, or skip all but one.
        compression: Codec of the new files; by default those of the data sets.
        workers: Number of processes.
        force: Replace the data set that is in the folder.

    Returns:
        Exit status.
    """
    from openvima.data.subsets import MergeConfig
    from openvima.data.subsets import merge as write_merged
    from openvima.errors import ConfigError

    if len(folders) < 2:
        raise ConfigError("give at least two folders: what to merge, and last where to write it.")
    config = MergeConfig(
        folders[:-1], folders[-1], parse_tasks(tasks), duplicates, compression, workers, force
    )
    with progress_bar("demonstrations") as report:
        print(write_merged(config, report=report))
    return 0
