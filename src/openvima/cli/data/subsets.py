"""`openvima data sample`, `split` and `merge`: data sets derived from others."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from openvima.cli.terminal import parse_tasks, progress_bar

Compression = Literal["lz4", "zstd"]


def sample(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    *,
    fraction: float,
    tasks: str = "all",
    seed: int = 0,
    compression: Compression | None = None,
    workers: int = 1,
    force: bool = False,
) -> int:
    """Sample a fraction of the demonstrations of each task.

    Samples of one seed are nested: the 1 % sample is a subset of the 10 % sample. Nothing in a demonstration
    is changed.

    Example: openvima data sample demos demos-1-percent --fraction 0.01

    Args:
        folder: The source.
        out: Folder to write to.
        fraction: Above 0, at most 1; at least one episode of each task is taken.
        tasks: Comma-separated names of tasks, or "all".
        seed: Seed of the sample.
        compression: Codec of the new files; by default that of the source.
        workers: Number of processes.
        force: Replace a data set in the folder.

    Returns:
        Exit status.
    """
    from openvima.data.subsets import SubsetConfig
    from openvima.data.subsets import sample as write_sample

    config = SubsetConfig(folder, out, parse_tasks(tasks), seed, compression, workers, force)
    with progress_bar("demonstrations") as report:
        print(write_sample(config, fraction, report=report))
    return 0


def split(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    *,
    splits: str,
    tasks: str = "all",
    seed: int = 0,
    compression: Compression | None = None,
    workers: int = 1,
    force: bool = False,
) -> int:
    """Divide demonstrations into splits, such as for training and validation.

    Each episode is assigned to one split by a hash and stays there when episodes are added. Sizes therefore
    match the fractions approximately.

    Example: openvima data split demos divided --splits training=0.923,validation=0.077

    Args:
        folder: The source.
        out: Folder to write to, with one data set per split.
        splits: Comma-separated NAME=FRACTION pairs; the fractions add up to 1.
        tasks: Comma-separated names of tasks, or "all".
        seed: Seed of the assignment.
        compression: Codec of the new files; by default that of the source.
        workers: Number of processes.
        force: Replace data sets in the folder.

    Returns:
        Exit status.
    """
    from openvima.data.subsets import SubsetConfig, parse_splits
    from openvima.data.subsets import split as write_split

    config = SubsetConfig(folder, out, parse_tasks(tasks), seed, compression, workers, force)
    fractions = parse_splits(splits)
    with progress_bar("demonstrations") as report:
        written = write_split(config, fractions, report=report)
    for name in fractions.fractions:
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
    """Merge data sets, whatever their tasks, levels, settings and versions.

    Files are copied byte for byte unless another compression is asked for or episodes are skipped.

    Example: openvima data merge rotations stacks all-demos

    Args:
        folders: The sources, and last the folder to write to.
        tasks: Comma-separated names of tasks, or "all".
        duplicates: Refuse episodes that several sources contain, or skip all but one.
        compression: Codec of the new files; by default those of the sources.
        workers: Number of processes.
        force: Replace a data set in the folder.

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
