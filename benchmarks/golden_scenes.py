"""Reader of recorded scenes of the public benchmark, and the comparison of our images with its images.

A folder of scenes holds `TASK-SEED.json` (objects with the poses and shapes that the benchmark had, and
prompt images with their objects) and `TASK-SEED.npz` (its images). Poses are those of centres of mass.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from openvima.catalog import Assets, Vector3, object_spec
from openvima.render import VIEWS, empty_labels, stamp
from openvima.scene import BACKGROUND_ID, ObjectImage, Placement, Pose, Prompt, Scene

SWEPT_MAGNIFICATION = 7.0  # of the small block in prompt images
FLAT_THICKNESS_M = 1e-4  # heights that differ by less count as equal

Views = dict[str, np.ndarray]


@dataclass(frozen=True, slots=True, eq=False)
class RecordedImage:
    """What the benchmark drew: per view colours (3, 128, 256) and object ids (128, 256), uint8."""

    rgb: Views
    segm: Views


@dataclass(frozen=True, slots=True, eq=False)
class GoldenScene:
    """One recorded scene.

    Args:
        task: Name of the task.
        seed: Seed of the benchmark.
        scene: The objects at their link-frame poses.
        image: The benchmark's images of it.
        prompt: The object images of the prompt that can be redrawn, under the benchmark's names.
        prompt_images: The benchmark's images of these.
        num_not_redrawn: Prompt images that the record does not say enough about: scenes without poses, and
            examples of adjectives, whose scale is not recorded.
    """

    task: str
    seed: int
    scene: Scene
    image: RecordedImage
    prompt: Prompt
    prompt_images: dict[str, RecordedImage]
    num_not_redrawn: int


def read_scenes(folder: Path) -> Iterator[GoldenScene]:
    """Read all scenes of a folder, in the order of their names."""
    for path in sorted(folder.glob("*.json")):
        yield read_scene(path)


def read_scene(path: Path) -> GoldenScene:
    """Read one scene; its images lie beside `path` under the same name, with the suffix .npz."""
    record = json.loads(path.read_text(encoding="utf-8"))
    with np.load(path.with_suffix(".npz")) as arrays:
        images = {name: arrays[name] for name in arrays.files}
    scene = Scene(tuple(_placement(body) for body in record["objects"]), record["end_effector"])
    shown = {
        name: fill
        for name, asset in record["assets"].items()
        if (fill := _object_image(name, asset, scene)) is not None
    }
    return GoldenScene(
        task=record["task"],
        seed=record["seed"],
        scene=scene,
        image=_recorded(images, ""),
        prompt=Prompt(" ".join("{" + name + "}" for name in shown), tuple(shown.items())),
        prompt_images={name: _recorded(images, f"asset/{name}/") for name in shown},
        num_not_redrawn=len(record["assets"]) - len(shown),
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


def _object_image(name: str, asset: dict[str, Any], scene: Scene) -> ObjectImage | None:
    if asset["type"] != "object" or name.startswith("demo_"):
        return None
    (shown,) = asset["objects"]
    same_object = [placement for placement in scene.placements if placement.object == shown["name"]]
    same_both = [placement for placement in same_object if placement.texture == shown["texture"]]
    placement = (same_both or same_object)[0]
    neutral = shown["texture"] == "gray"
    # Neutral images do not give away the scale that an adjective stands for.
    scale = (1.0, 1.0, 1.0) if neutral else placement.scale
    placement = Placement(
        0, shown["name"], shown["texture"], placement.size, Pose((0.0, 0.0, 0.0)), scale=scale
    )
    return ObjectImage(placement, SWEPT_MAGNIFICATION if shown["name"] == "small block" else 1.0)


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
    """Compare two segmentation images body by body.

    Args:
        ours: Object ids, shape (H, W), uint8.
        theirs: The same.
        first_id: Smallest id of an object; what is below, such as the floor, is not compared.
        groups: Sets of ids to be taken as one body.

    Returns:
        For every object seen in either image its ids (several for a group) and its intersection over union.
    """
    grouped = set().union(*groups)
    seen = {int(i) for i in np.union1d(ours, theirs) if first_id <= i < BACKGROUND_ID}
    bodies = [(i,) for i in sorted(seen - grouped)] + [tuple(sorted(group)) for group in groups]
    result = {}
    for ids in bodies:
        a, b = np.isin(ours, ids), np.isin(theirs, ids)
        if union := (a | b).sum():
            result[ids] = float((a & b).sum() / union)
    return result


def mean_colour_error(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return the mean absolute difference of two colour images, in levels of 255."""
    return float(np.abs(ours.astype(np.int16) - theirs.astype(np.int16)).mean())
