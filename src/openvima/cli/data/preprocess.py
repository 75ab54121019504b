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
    boxes: str | None = None,
    out: Path | None = None,
    workers: int = 1,
) -> int:
    """Make the token cache of a folder of demonstrations, or what it still lacks.

    It holds what policies see: the crops of all objects with their boxes, or whole frames at half the size.
    `openvima train` makes it when it is missing; made beforehand, several processes can share the work. It
    may be deleted at any time. An interrupted command goes on where it stopped, shard by shard.

    Example: openvima data tokens demos --workers 2

    Args:
        folder: Folder of demonstrations.
        kind: objects for all presets that see objects, frames for gato, flamingo and gpt.
        boxes: Detector that finds the objects instead, for `openvima train --loader.boxes`: "detector" for
            the bundled one, detector=FOLDER for one that `openvima detector train` made, or MODULE:FUNCTION
            or FILE.py:FUNCTION, which makes an ObjectExtractor.
        out: Folder to keep it in; by default "tokens" in the folder of demonstrations.
        workers: Number of processes.

    Returns:
        Exit status.
    """
    from openvima.data.object_cache.cache import open_object_cache
    from openvima.data.reader import Dataset
    from openvima.detector.plugins import detected_object_cache, plugged_boxes
    from openvima.errors import ConfigError

    if boxes is not None and kind == "frames":
        raise ConfigError(f"boxes is {boxes!r}, but whole frames have none; leave --boxes or --kind out.")
    dataset = Dataset(folder)
    with progress_bar("tokens") as report:
        if boxes is None:
            cache = open_object_cache(dataset, kind, folder=out, workers=workers, report=report)
        else:
            cache = detected_object_cache(
                dataset, plugged_boxes(boxes), folder=out, workers=workers, report=report
            )
    print(f"tokens of {len(cache):,} demonstrations are ready.", file=sys.stderr)
    print(cache.folder)
    return 0
