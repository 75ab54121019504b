"""`openvima data tokens`: cut objects out of demonstrations, once for all trainings."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from openvima.cli.progress import progress_bar


def tokens(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    *,
    kind: Literal["objects", "frames"] = "objects",
    out: Path | None = None,
    workers: int = 1,
) -> int:
    """Make the token cache of a folder of demonstrations, or what it still lacks.

    It holds what policies see: the crops of all objects with their boxes, or whole frames at half the size.
    `openvima train` makes it when it is missing; made beforehand, several processes can share the work. It
    may be deleted at any time.

    Example: openvima data tokens demos --workers 2

    Args:
        folder: Folder of demonstrations.
        kind: objects for all presets that see objects, frames for gato, flamingo and gpt.
        out: Folder to keep it in; by default "tokens" in the folder of demonstrations.
        workers: Number of processes.

    Returns:
        Exit status.
    """
    from openvima.data.reader import Dataset
    from openvima.data.tokens.cache import open_tokens

    with progress_bar("tokens") as report:
        cache = open_tokens(Dataset(folder), kind, folder=out, workers=workers, report=report)
    print(f"tokens of {len(cache):,} demonstrations are ready.", file=sys.stderr)
    print(cache.folder)
    return 0
