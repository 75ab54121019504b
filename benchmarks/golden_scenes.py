"""Reader of recorded scenes of the public benchmark, and the comparison of our images with its images.

A folder of scenes holds `TASK-SEED.json` (objects with the poses and shapes that the benchmark had, and
prompt images with their objects) and `TASK-SEED.npz` (its images). Poses are those of centres of mass.
"""

import json
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from openvima.catalog import Assets, Vector3, object_spec
from openvima.errors import OpenVimaError
from openvima.render import VIEWS, empty_labels, stamp
from openvima.scene import BACKGROUND_ID, ObjectImage, Placement, Pose, Scene

SWEPT_MAGNIFICATION = 7.0  # of the small block in prompt images
FLAT_THICKNESS_M = 1e-4  # heights that differ by less count as equal
MIN_PIXELS = 30  # smaller remainders of bodies are not compared: a pixel more or less would decide

Views = dict[str, np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedImage:
    """What the benchmark drew: per view colours (3, 128, 256) and object ids (128, 256), uint8."""

    rgb: Views
    segm: Views


@dataclass(frozen=True, slots=True, eq=False)
class GoldenPrompt:
    """One recorded prompt image.

    Args:
        name: Its placeholder in the prompt.
        image: The benchmark's image.
        candidates: What an image of one object may show. Its pose is always the same; its size and scale are
            those of the same object in the scene, of which there may be several, or the scales of any body in
            the scene where the image is an example for an adjective. Empty for images of scenes.
        shown: Object and texture names of an image of a scene, in the order of their ids from 2 on. Where
            they lie is not recorded.
    """

    name: str
    image: RecordedImage
    candidates: tuple[ObjectImage, ...]
    shown: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True, eq=False)
class GoldenScene:
    """One recorded scene.

    Args:
        task: Name of the task.
        seed: Seed of the benchmark.
        scene: The objects at their link-frame poses.
        image: The benchmark's images of it.
        prompts: The images of the prompt.
    """

    task: str
    seed: int
    scene: Scene
    image: RecordedImage
    prompts: tuple[GoldenPrompt, ...]


class RecordingError(ValueError):
    """A recording is missing, damaged or of another form."""


def scene_files(folder: Path) -> list[Path]:
    """List the records of a folder of scenes, in the order of their names.

    Raises:
        RecordingError: There are none.
    """
    paths = sorted(folder.glob("*.json"))
    if not paths:
        raise RecordingError(f"{folder} holds no recorded scenes (TASK-SEED.json); give another folder.")
    return paths


def read_scenes(folder: Path) -> Iterator[GoldenScene]:
    """Read all scenes of a folder; see `scene_files` and `read_scene`."""
    yield from map(read_scene, scene_files(folder))


def read_scene(path: Path) -> GoldenScene:
    """Read one scene; its images lie beside `path` under the same name, with the suffix .npz.

    Raises:
        RecordingError: One of the two files is missing, damaged or lacks something.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        with path.with_suffix(".npz").open("rb") as file, np.load(file) as arrays:
            images = {name: arrays[name] for name in arrays.files}
        return _golden_scene(record, images)
    except (OpenVimaError, OSError, ValueError, zipfile.BadZipFile) as error:
        raise RecordingError(f"{path.with_suffix('')}.{{json,npz}}: {error}") from error
    except KeyError as error:
        raise RecordingError(f"{path.with_suffix('')}.{{json,npz}} lack the entry {error}.") from error


def _golden_scene(record: dict[str, Any], images: Views) -> GoldenScene:
    scene = Scene(tuple(_placement(body) for body in record["objects"]), record["end_effector"])
    return GoldenScene(
        task=record["task"],
        seed=record["seed"],
        scene=scene,
        image=_recorded(images, ""),
        prompts=tuple(_prompt(name, asset, scene, images) for name, asset in record["assets"].items()),
    )


def _prompt(name: str, asset: dict[str, Any], scene: Scene, images: Views) -> GoldenPrompt:
    is_object = asset["type"] == "object"
    return GoldenPrompt(
        name,
        _recorded(images, f"asset/{name}/"),
        _candidates(name, asset["objects"][0], scene) if is_object else (),
        () if is_object else tuple((body["name"], body["texture"]) for body in asset["objects"]),
    )


def _recorded(images: Views, prefix: str) -> RecordedImage:
    return RecordedImage(
        {view: images[f"{prefix}rgb_{view}"] for view in VIEWS},
        {view: images[f"{prefix}segm_{view}"] for view in VIEWS},
    )


def link_pose(body: dict[str, Any]) -> Pose:
    """Convert the recorded pose of a body's centre of mass to that of its link frame."""
    x, y, z = body["pos"]
    qx, qy, qz, qw = body["quat_xyzw"]
    offset = Pose(object_spec(body["name"]).com_offset)
    return Pose((x, y, z), (qx, qy, qz, qw)) @ offset.inverse()


def _placement(body: dict[str, Any]) -> Placement:
    size, scale = size_and_scale(body)
    return Placement(
        id=body["id"],
        object=body["name"],
        texture=body["texture"],
        size=size,
        pose=link_pose(body),
        fixed=body["category"] == "fixed",
        scale=scale,
    )


def size_and_scale(body: dict[str, Any]) -> tuple[Vector3, Vector3]:
    """Find the nominal size and task scale with which the catalogue gives the recorded shapes.

    Args:
        body: An object record; its shapes hold either full extents of boxes or scales of meshes.
    """
    spec = object_spec(body["name"])
    shapes = body["shapes"]
    x, y, z = shapes[0]["dims"]
    if spec.kit_scale is not None:
        plain = (0.003 * spec.kit_scale, 0.003 * spec.kit_scale, 0.001 * spec.kit_scale / 1.1)
        return spec.size_max, (x / plain[0], y / plain[1], z / plain[2])
    if body["name"] == "container":
        return (x, y, spec.size_min[2]), (1.0, 1.0, 1.0)
    if body["name"] == "three-sided rectangle":
        return (shapes[1]["dims"][1], x, 0.0), (1.0, 1.0, 1.0)
    if spec.kind == "mesh":
        return spec.size_max, (1.0, 1.0, 1.0)
    return (x, y, z), (1.0, 1.0, 1.0)


def _candidates(name: str, shown: dict[str, Any], scene: Scene) -> tuple[ObjectImage, ...]:
    """What the image of one object may show, as far as the record of the scene tells."""
    same_object = [placement for placement in scene.placements if placement.object == shown["name"]]
    same_both = [placement for placement in same_object if placement.texture == shown["texture"]]
    sizes = [placement.size for placement in same_both or same_object]
    sizes = sizes or [object_spec(shown["name"]).size_max]  # all sizes that a scene does not tell are fixed
    scales = [(1.0, 1.0, 1.0)]
    if name.startswith("demo_"):  # examples have the scales between which the scene's objects differ
        scales += [placement.scale for placement in scene.placements]
    elif same_both:  # images in neutral gray do not give away the scale
        scales = [placement.scale for placement in same_both]
    magnification = SWEPT_MAGNIFICATION if shown["name"] == "small block" else 1.0
    body = Placement(0, shown["name"], shown["texture"], sizes[0], Pose((0.0, 0.0, 0.0)))
    forms = dict.fromkeys((size, scale) for size in sizes for scale in scales)
    return tuple(ObjectImage(replace(body, size=size, scale=scale), magnification) for size, scale in forms)


def interpenetrating(scene: Scene, assets: Assets) -> list[set[int]]:
    """Group the bodies that overlap at equal heights: which one shows is left to rounding in the benchmark.

    Returns:
        Disjoint sets of two or more object ids.
    """
    maps = []
    for placement in scene.placements:
        labels, heights = empty_labels()
        stamp(labels, heights, placement, assets)
        maps.append((placement.id, labels > 0, heights))
    groups: list[set[int]] = []
    for i, (a, mask_a, heights_a) in enumerate(maps):
        for b, mask_b, heights_b in maps[i + 1 :]:
            if (mask_a & mask_b & (np.abs(heights_a - heights_b) < FLAT_THICKNESS_M)).any():
                touching = [group for group in groups if a in group or b in group]
                groups = [group for group in groups if group not in touching]
                groups.append({a, b}.union(*touching))
    return groups


def ious(
    ours: np.ndarray, theirs: np.ndarray, *, first_id: int, groups: list[set[int]]
) -> dict[tuple[int, ...], float]:
    """Compare two segmentation images body by body, leaving out what is smaller than 30 pixels in both.

    Args:
        ours: Object ids, shape (H, W), uint8.
        theirs: The same.
        first_id: Smallest id of an object; what is below, such as the floor, is not compared.
        groups: Sets of ids to be taken as one body.

    Returns:
        For every object of that size its ids (several for a group) and its intersection over union.
    """
    grouped = set().union(*groups)
    seen = {int(i) for i in np.union1d(ours, theirs) if first_id <= i < BACKGROUND_ID}
    bodies = [(i,) for i in sorted(seen - grouped)] + [tuple(sorted(group)) for group in groups]
    result = {}
    for ids in bodies:
        a, b = np.isin(ours, ids), np.isin(theirs, ids)
        if max(a.sum(), b.sum()) >= MIN_PIXELS:
            result[ids] = float((a & b).sum() / (a | b).sum())
    return result


def mean_colour_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the mean absolute difference of two colour images, in levels of 255."""
    return float(np.abs(ours.astype(np.int16) - theirs.astype(np.int16)).mean())
