"""What makes scenes for matching harder: random looks, twins that differ in one respect, and a second laying.

Nothing here knows more of the catalogue than the training partition that it is handed.
"""

import math
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.catalog.partitions import OBJECT_SETS
from openvima.catalog.random_pack import is_random, random_name
from openvima.catalog.textures import texture_spec
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Placement, Pose, Scene

_MOVABLE, _CONTAINERS = OBJECT_SETS["D_shape"], OBJECT_SETS["B_train"]
_NUM_PALETTE = 3  # random textures of a scene, so that some of its objects share one
_STRETCH = (1.35, 2.2)  # factor between the heights of twins
_TWIN_TRIES = 20
_TWIN_APART_M = 0.12
_EDGE_M = 0.06  # from the edge of the workspace to the middle of what is laid there
_JITTER_M = 0.02
_TWIN_KINDS = ("height", "shade", "texture", "shape")


def with_random_looks(scene: Scene, share: float, assets: Assets, rng: np.random.Generator) -> Scene:
    """Give some of the objects a random texture, and some a random shape.

    Args:
        scene: Objects of the training partition; those that are neither moved nor put into keep their shape.
        share: How probable either is for each object.
        assets: A pack that knows random looks.
        rng: Every draw comes from here.
    """
    palette = [random_name("texture", rng) for _ in range(_NUM_PALETTE)]
    # Vessels that were alike stay alike in half of the scenes: then their textures alone tell them apart.
    common = {} if rng.random() < 0.5 else None
    placements = []
    for placement in scene.placements:
        if rng.random() < share:
            dark = "dark " if rng.random() < 0.25 else ""
            placement = replace(placement, texture=dark + palette[int(rng.integers(_NUM_PALETTE))])
        if rng.random() < share:
            placement = _with_random_shape(placement, assets, rng, common)
        placements.append(placement)
    return replace(scene, placements=tuple(placements))


def with_twins(
    scene: Scene, share: float, shades: AbstractSet[str], assets: Assets, rng: np.random.Generator
) -> Scene:
    """Put a twin of some objects on the table that differs in height, in shade, in texture or in shape.

    Args:
        scene: The scene.
        share: How probable a twin is for each object that can be moved; there may be no room for it.
        shades: Textures, light and dark, that movable objects may have.
        assets: Where shapes come from.
        rng: Every draw comes from here.
    """
    placements = list(scene.placements)
    for original in scene.placements:
        has_twin = original.object in _MOVABLE or is_random(original.object)
        if original.fixed or not has_twin or rng.random() >= share:
            continue
        place = _free_place(placements, rng)
        kind = _TWIN_KINDS[int(rng.integers(len(_TWIN_KINDS)))]
        twin = _differing(original, kind, scene.placements, shades, assets, rng)
        if place and twin:
            pose = Pose.planar(*place, rng.uniform(0, 2 * math.pi), z=twin.pose.z)
            placements.append(replace(twin, id=placements[-1].id + 1, pose=pose))
    return replace(scene, placements=tuple(placements))


def laid_again(scene: Scene, rng: np.random.Generator) -> tuple[Scene, dict[int, float]]:
    """Turn everything by a random angle; in half of the scenes objects change places, too.

    Returns:
        The scene, and the turn of each object by id: counter-clockwise seen from above, in 0 … 2π.
    """
    turns = {p.id: rng.uniform(0, 2 * math.pi) for p in scene.placements}
    movable = [p for p in scene.placements if not p.fixed]
    places = {p.id: (p.pose.x, p.pose.y) for p in scene.placements}
    if rng.random() < 0.5:
        others = [movable[int(number)].pose for number in rng.permutation(len(movable))]
        places |= {p.id: _near(other, rng) for p, other in zip(movable, others, strict=True)}
    poses = {
        p.id: Pose((*places[p.id], p.pose.z), p.pose.rotated(turns[p.id]).quaternion)
        for p in scene.placements
    }
    return scene.with_poses(poses), turns


def _with_random_shape(
    placement: Placement, assets: Assets, rng: np.random.Generator, common: dict[str, str] | None
) -> Placement:
    kind = (
        "shape" if placement.object in _MOVABLE else "container" if placement.object in _CONTAINERS else None
    )
    if kind is None:
        return placement
    name = random_name(kind, rng)
    if common is not None and kind == "container":
        name = common.setdefault(placement.object, name)
    return _at_rest(replace(placement, object=name), assets)


def _at_rest(placement: Placement, assets: Assets) -> Placement:
    """Put an object on the table at the height of its own shape."""
    height = assets.geometry(placement.object, placement.size, placement.scale).rest_z_m
    return placement.at(Pose((placement.pose.x, placement.pose.y, height), placement.pose.quaternion))


def _differing(
    original: Placement,
    kind: str,
    others: Sequence[Placement],
    shades: AbstractSet[str],
    assets: Assets,
    rng: np.random.Generator,
) -> Placement | None:
    """The same object, but for one respect; None where it cannot differ in that."""
    if kind == "height":
        x, y, z = original.scale
        stretch = rng.uniform(*_STRETCH)
        factor = stretch if rng.random() < 0.5 else 1 / stretch
        return _at_rest(replace(original, scale=(x, y, z * factor)), assets)
    if kind == "shade":
        shade = _other_shade(original.texture, shades)
        return None if shade is None else replace(original, texture=shade)
    if kind == "texture":
        names = [p.texture for p in others if not p.fixed and p.texture != original.texture]
        return replace(original, texture=names[int(rng.integers(len(names)))]) if names else None
    shapes = [p for p in others if not p.fixed and p.object != original.object]
    if not shapes:
        return None
    shape = shapes[int(rng.integers(len(shapes)))]
    changed = replace(original, object=shape.object, size=shape.size, scale=shape.scale)
    return _at_rest(changed, assets)


def _other_shade(texture: str, shades: AbstractSet[str]) -> str | None:
    if is_random(texture):
        return texture.removeprefix("dark ") if texture.startswith("dark ") else f"dark {texture}"
    spec = texture_spec(texture)
    other = spec.light_variant if spec.is_dark else spec.dark_variant
    return other if other in shades else None


def _free_place(placements: Sequence[Placement], rng: np.random.Generator) -> tuple[float, float] | None:
    """A place where no other object is near, or None where none was found."""
    for _ in range(_TWIN_TRIES):
        x, y = rng.uniform(np.array(WORKSPACE_LOW) + _EDGE_M, np.array(WORKSPACE_HIGH) - _EDGE_M).tolist()
        if all(math.hypot(x - p.pose.x, y - p.pose.y) >= _room(p) for p in placements):
            return x, y
    return None


def _room(placement: Placement) -> float:
    return _TWIN_APART_M + (0.06 if placement.fixed else 0.0)


def _near(pose: Pose, rng: np.random.Generator) -> tuple[float, float]:
    """A place beside another one, on the table."""
    x, y = np.array((pose.x, pose.y)) + rng.uniform(-_JITTER_M, _JITTER_M, 2)
    low, high = np.array(WORKSPACE_LOW) + _EDGE_M, np.array(WORKSPACE_HIGH) - _EDGE_M
    x, y = np.clip((x, y), low, high).tolist()
    return x, y
