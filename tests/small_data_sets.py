"""Small data sets and results, sampled or made up."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from openvima.data import Dataset, Demonstration, GenerateConfig, ShardWriter
from openvima.data.encoding import ShardInfo
from openvima.data.lerobot import LerobotConfig, export_lerobot
from openvima.data.manifest import MANIFEST_NAME, finish_folder, manifest_checksum
from openvima.data.subsets import MergeConfig, SubsetConfig, merge, sample, split
from openvima.errors import DatasetError
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.perception.preprocessing import ObjectTable
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt
from openvima.video.encoder import Clip, png

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


def folder_writers(source: Path, out: Path) -> tuple[Callable[[], object], ...]:
    """All commands that write a folder as a whole from another one."""
    return (
        lambda: merge(MergeConfig((source,), out)),
        lambda: sample(SubsetConfig(source, out), 1.0),
        lambda: split(SubsetConfig(source, out), {"a": 0.5, "b": 0.5}),
        lambda: export_lerobot(LerobotConfig(source, out)),
    )


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
    except DatasetError:
        return None


def flip_bit(path: Path, place: int | None = None) -> None:
    """Damage a file at a place, or in the middle."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2 if place is None else place] ^= 1
    path.write_bytes(content)


def frames_of(path: Path) -> list[np.ndarray]:
    """All frames of a video, shape (H, W, 3) each."""
    import av

    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


TASKS = ("rotate", "sweep_without_exceeding")


def config(out: Path, **changes: object) -> GenerateConfig:
    """Three episodes of two tasks, in shards of two."""
    return replace(GenerateConfig(out=out, tasks=TASKS, episodes=3, shard_size=2), **changes)


def rows_of(table: ObjectTable) -> np.ndarray:
    """All fields of each object in one row: id, two indices of images, two boxes, two grasp points."""
    columns = (table.ids, table.crop_index, table.boxes, table.grasps)
    return np.concatenate(
        [column.reshape(len(table), int(np.prod(column.shape[1:]))) for column in columns], axis=1
    )


def seeds_of(entry: Mapping[str, Any]) -> list[int]:
    """All seeds of a task in the record."""
    return [seed for first, last in entry["seeds"] for seed in range(first, last + 1)]


VERSIONS = {"openvima": "9.8.7", "mujoco": "1.2.3"}
CONFIG = {"policies": ["mine", "oracle", "random"], "tasks": ["all"], "levels": ["L1", "L3"], "episodes": 10}


def outcomes(num_solved: int) -> tuple[EpisodeOutcome, ...]:
    failed = ("object 6 (red <swirl> letter A) left the workspace", "object left the workspace")
    return tuple(EpisodeOutcome(i, i < num_solved, 2, *(() if i < num_solved else failed)) for i in range(10))


@pytest.fixture(scope="session")
def results() -> Results:
    """Three policies on two tasks at L1 and one at L3; `mine` solves 9 and 6 of 10 at L1."""
    solved = {
        "mine": {("rotate", "L1"): 9, ("stack<b>", "L1"): 6, ("rotate", "L3"): 3},
        "oracle": {("rotate", "L1"): 10, ("stack<b>", "L1"): 10, ("rotate", "L3"): 10},
        "random": {("rotate", "L1"): 0, ("stack<b>", "L1"): 1, ("rotate", "L3"): 0},
    }
    rows = tuple(
        Row(policy, task, level, 1, outcomes(number))
        for policy, cells in solved.items()
        for (task, level), number in cells.items()
    )
    policies = {
        "mine": {"kind": "run", "sha256": "ab" * 32},
        "oracle": {"kind": "oracle"},
        "random": {"kind": "random"},
    }
    return Results(rows, CONFIG, VERSIONS, policies)


def prompt_image(name: str, rows: slice, columns: slice, colour: tuple[int, int, int]) -> PromptImage:
    rgb = np.full((3, 128, 256), 255, np.uint8)
    segm = np.full((128, 256), 255, np.uint8)
    rgb[:, rows, columns] = np.array(colour, np.uint8)[:, None, None]
    segm[rows, columns] = 0
    views = ("front", "top")
    record = ObjectRecord(0, "block", "red")
    return PromptImage(name, "object", dict.fromkeys(views, rgb), dict.fromkeys(views, segm), (record,))


@pytest.fixture(scope="session")
def prompt() -> RenderedPrompt:
    """A prompt with a green and a red picture."""
    images = {
        "a": prompt_image("a", slice(50, 80), slice(100, 130), (0, 200, 0)),
        "b": prompt_image("b", slice(40, 90), slice(90, 170), (200, 0, 0)),
    }
    return RenderedPrompt("Put the {a} into the {b}.", images)


@pytest.fixture(scope="session")
def clip() -> Clip:
    """A filmed failure; the film itself is not a real one."""
    picture = png(Image.new("RGB", (40, 20), (10, 120, 200)))
    prompt = ("Put the", picture, "into the", picture, ".")
    return Clip("mine", "rotate", "L1", 9, False, 2, "object <6> left", prompt, b"not a film", picture)
