"""`openvima data preprocess`: extract the objects of demonstrations once for all trainings."""

import sys
from pathlib import Path
from typing import Annotated, Literal

import tyro

from openvima.cli.terminal import progress_bar


def preprocess(
    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FOLDER")],
    *,
    kind: Literal["objects", "frames"] = "objects",
    boxes: str | None = None,
    fraction: float = 1.0,
    rerendered: int | None = None,
    out: Path | None = None,
    workers: int = 1,
) -> int:
    """Write the object cache of a folder of demonstrations, or the shards that it lacks.

    The cache holds the inputs of policies: crops and boxes of all objects, or whole frames at half the size.
    `openvima train` writes it when it is missing; beforehand, several processes can share the work. It may be
    deleted at any time. An interrupted command resumes after the last whole shard.

    Example: openvima data preprocess demos --workers 2

    Args:
        folder: Folder of demonstrations.
        kind: objects for presets with object tokens, frames for gato, flamingo and gpt.
        boxes: Detector that extracts the objects, for `openvima train --loader.boxes`: "detector" for the
            bundled one, detector=FOLDER for one trained with `openvima detector train`, or MODULE:FUNCTION or
            FILE.py:FUNCTION, which returns an ObjectExtractor. Default: the segmentation.
        fraction: Fraction of the demonstrations in which `boxes` detects objects, for `openvima train
            --loader.detected-fraction`.
        rerendered: Number of a random appearance, from 0, to render the demonstrations again with, for
            `openvima train --loader.rerendered-prob`. Default: as they are stored.
        out: Folder of the cache; default: "object_cache" in the folder of demonstrations.
        workers: Number of processes.

    Returns:
        Exit status.
    """
    from openvima.data.object_cache import open_object_cache
    from openvima.data.reader import Dataset
    from openvima.detector.plugins import detected_object_cache, plugged_boxes
    from openvima.errors import ConfigError

    if boxes is not None and kind == "frames":
        raise ConfigError(f"boxes is {boxes!r}, but whole frames have none; leave --boxes or --kind out.")
    if rerendered is not None and (boxes is not None or rerendered < 0):
        raise ConfigError(f"rerendered is {rerendered}; it must be 0 or more, and without --boxes.")
    if not 0 <= fraction <= 1 or (fraction < 1 and boxes is None):
        raise ConfigError(
            f"fraction is {fraction:g}; it must lie between 0 and 1, and needs --boxes below 1."
        )
    dataset = Dataset(folder)
    with progress_bar("object cache") as report:
        if boxes is None:
            cache = open_object_cache(
                dataset, kind, folder=out, appearance=rerendered, workers=workers, report=report
            )
        else:
            cache = detected_object_cache(
                dataset, plugged_boxes(boxes, fraction=fraction), folder=out, workers=workers, report=report
            )
    print(f"the object cache of {len(cache):,} demonstrations is ready.", file=sys.stderr)
    print(cache.folder)
    return 0
