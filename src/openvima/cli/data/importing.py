"""`openvima data import`: the published demonstrations as a data set of this package."""

import json
import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from openvima.cli.terminal import parse_list, progress_bar


def import_published(
    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOURCE")],
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")],
    *,
    tasks: str = "all",
    split: Literal["all", "train", "validation"] = "all",
    episodes: int | None = None,
    compression: Literal["lz4", "zstd"] = "zstd",
    workers: int = 1,
    force: bool = False,
) -> int:
    """Convert the demonstrations that the benchmark's authors published; docs/published_data.md says how.

    The zip archive is read where it is, without unpacking it, and nothing in it is run. Broken episodes are
    left out and named in OUT/broken.json. Repeating a command that was interrupted continues it.

    Example: openvima data import vima.zip published --workers 2

    Args:
        source: The zip archive, or a folder with unpacked episodes.
        out: Folder to write to.
        tasks: Old or new names of tasks with commas between them, or "all".
        split: All episodes, or one of two splits: train (twelve thirteenths) or validation.
        episodes: At most so many episodes of each task, the first ones; by default all.
        compression: Codec of the files; lz4 takes twice the space and is read faster.
        workers: Number of processes.
        force: Delete the data set that is in OUT.

    Returns:
        Exit status.
    """
    from openvima.data.manifest import BROKEN_NAME
    from openvima.data.published import ImportConfig
    from openvima.data.published import import_published as convert

    config = ImportConfig(
        source=source,
        out=out,
        tasks=parse_list(tasks),
        split=split,
        episodes=episodes,
        compression=compression,
        workers=workers,
        force=force,
    )
    with progress_bar("episodes") as report:
        folder = convert(config, report)
    if (folder / BROKEN_NAME).is_file():
        first, *others = json.loads((folder / BROKEN_NAME).read_text(encoding="utf-8"))
        print(
            f"{1 + len(others)} left out, see {folder / BROKEN_NAME}; "
            f"first {first['member']}: {first['reason']}",
            file=sys.stderr,
        )
    print(folder)
    return 0
