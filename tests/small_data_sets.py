"""Small data sets that no simulation made, and ways to damage their files, for tests of verification."""

import dataclasses
import json
import random
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from damage import damaged
from openvima.data import Dataset, Demonstration, Shard, ShardWriter
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import MANIFEST_NAME, finish_folder, manifest_checksum
from openvima.errors import DatasetError, ShardError

MERGE = "openvima data merge"  # a command whose work nothing repeats


def with_plain_images(demo: Demonstration) -> Demonstration:
    """The demonstration with images of one colour, which take little room."""
    shade = demo.seed % 200

    def plain(images: dict[str, np.ndarray], value: int) -> dict[str, np.ndarray]:
        return {view: np.full_like(pixels, value) for view, pixels in images.items()}

    prompt_images = {
        name: dataclasses.replace(image, rgb=plain(image.rgb, shade), segm=plain(image.segm, 255))
        for name, image in demo.prompt.images.items()
    }
    prompt = dataclasses.replace(demo.prompt, images=prompt_images)
    return dataclasses.replace(demo, rgb=plain(demo.rgb, shade), segm=plain(demo.segm, 5), prompt=prompt)


def write_folder(
    folder: Path,
    info: ShardInfo,
    shards: Sequence[Sequence[Demonstration]],
    *,
    command: str = MERGE,
    licence: str = "MIT",
) -> Path:
    """Write a finished data set of one task."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, demos in enumerate(shards):
        path = folder / f"{info.task}-{info.level}-{number:05d}.arrow"
        with ShardWriter(path, dataclasses.replace(info, number=number)) as writer:
            for demo in demos:
                writer.write(demo)
    finish(folder, info, command=command, licence=licence)
    return folder


def finish(folder: Path, info: ShardInfo, *, command: str = MERGE, licence: str = "MIT") -> None:
    """Write index and manifest of the shards that are in a folder."""
    shards = sorted(folder.glob("*.arrow"))
    finish_folder(folder, shards, command=command, config={}, versions=info.versions, licence=licence)


def edit_manifest(folder: Path, edit: Callable[[dict], None]) -> None:
    """Change a manifest and make its own checksum fit, as no accident does."""
    path = folder / MANIFEST_NAME
    manifest = json.loads(path.read_text())
    edit(manifest)
    manifest["checksum"] = manifest_checksum(manifest)
    path.write_text(json.dumps(manifest))


def contents(folder: Path) -> dict[str, bytes]:
    """All files of a folder and of those inside, by name."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def read_all(folder: Path) -> list[str] | None:
    """Content hashes of a data set as it is read; None if reading ends with one of our errors."""
    try:
        return [demo.content_hash() for demo in Dataset(folder)]
    except (DatasetError, ShardError):
        return None


def read_damaged_shards(whole: Path, copy: Path, seeds: range, result: Path) -> None:
    """Read a shard after each of many accidents, without any checksum; to be run in a process of its own.

    Args:
        whole: The shard.
        copy: Where to write it with its damage.
        seeds: Of the accidents.
        result: Where to write the errors that are not ours, as JSON.
    """
    content, odd = whole.read_bytes(), []
    for seed in seeds:
        copy.write_bytes(damaged(content, random.Random(seed)))
        try:
            shard = Shard(copy)
            shard.table(["seed", "skipped"]).to_pylist()
            for row in range(len(shard)):
                shard[row].content_hash()
        except ShardError:
            pass
        except Exception as error:  # what the test looks for
            odd.append(f"seed {seed}: {type(error).__name__}: {error}")
    result.write_text(json.dumps(odd))
