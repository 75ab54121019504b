"""Augmentation of the scenes of contrastive pretraining.

Random textures and shapes (domain randomization); hard negatives, which differ from an object in one
respect; rearranged second views; and grayscale prompt images, as in `novel_noun`, which identify an object by
its shape alone.
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
from openvima.training.config import PretrainingConfig

_MOVABLE, _CONTAINERS = OBJECT_SETS["D_shape"], OBJECT_SETS["B_train"]
_PALETTE_SIZE = 3  # random textures of a scene, so that some of its objects share one


def with_random_appearance(
    scene: Scene, prob: float, assets: Assets, rng: np.random.Generator, settings: PretrainingConfig
) -> Scene:
    """Give some of the objects a random texture, and some a random shape.

    Args:
        scene: Objects of the training partition; only movable ones and containers get random shapes.
        prob: Probability of either for each object.
        assets: A pack with random textures and shapes.
        rng: Source of all draws.
        settings: How often which kinds of shapes.
    """
    palette = [random_name("texture", rng) for _ in range(_PALETTE_SIZE)]
    # In half of the scenes equal containers stay equal, so that only texture distinguishes them.
    common = {} if rng.random() < 0.5 else None
    placements = []
    for placement in scene.placements:
        if rng.random() < prob:
            dark = "dark " if rng.random() < 0.25 else ""
            placement = replace(placement, texture=dark + palette[rng.integers(_PALETTE_SIZE)])
        if rng.random() < prob and placement.object in (*_MOVABLE, *_CONTAINERS):
            is_container = placement.object in _CONTAINERS
            if is_container and _draw(settings.grating_prob, rng):
                kind = "grating"
            elif is_container:
                kind = "eared container" if _draw(settings.eared_prob, rng) else "container"
            elif _draw(settings.ring_and_block_prob, rng):
                kind = "ring" if rng.random() < 0.5 else "block"
            else:
                kind = "shape"
            name = random_name(kind, rng)
            if common is not None and is_container:
                name = common.setdefault(placement.object, name)
            placement = at_rest(replace(placement, object=name), assets)
        placements.append(placement)
    return replace(scene, placements=tuple(placements))


def at_rest(placement: Placement, assets: Assets) -> Placement:
    """Put an object on the table at the height of its own shape."""
    height = assets.geometry(placement.object, placement.size, placement.scale).rest_z_m
    return placement.at(Pose((placement.pose.x, placement.pose.y, height), placement.pose.quaternion))


def _draw(prob: float, rng: np.random.Generator) -> bool:
    return bool(prob) and bool(rng.random() < prob)  # draws nothing at 0, so that other draws stay


_EDGE_M = 0.06  # from the edge of the workspace to the middle of an object
_LOW, _HIGH = np.array(WORKSPACE_LOW) + _EDGE_M, np.array(WORKSPACE_HIGH) - _EDGE_M
_JITTER_M = 0.02


def rearrange(scene: Scene, rng: np.random.Generator) -> tuple[Scene, dict[int, float]]:
    """Rotate each object by a random angle; in half of the scenes movable objects also swap positions.

    Returns:
        The scene, and the rotation of each object by id: counter-clockwise seen from above, in 0 … 2π.
    """
    rotations = {p.id: rng.uniform(0, 2 * math.pi) for p in scene.placements}
    movable = [p for p in scene.placements if not p.fixed]
    positions = {p.id: (p.pose.x, p.pose.y) for p in scene.placements}
    swapped = dict[int, tuple[float, float]]()
    if rng.random() < 0.5:
        for placement, index in zip(movable, rng.permutation(len(movable)), strict=True):
            near = np.array(positions[movable[index].id]) + rng.uniform(-_JITTER_M, _JITTER_M, 2)
            x, y = np.clip(near, _LOW, _HIGH).tolist()  # inside the workspace
            swapped[placement.id] = x, y
    positions |= swapped
    poses = {
        p.id: Pose((*positions[p.id], p.pose.z), p.pose.rotated(rotations[p.id]).quaternion)
        for p in scene.placements
    }
    return scene.with_poses(poses), rotations


_KINDS = ("height", "shade", "texture", "shape")
_STRETCH = (1.35, 2.2)  # ratio of heights
_TRIES = 20
_CLEARANCE_M = {False: 0.12, True: 0.18}  # from movable and from fixed objects


def with_hard_negatives(
    scene: Scene, prob: float, shades: AbstractSet[str], assets: Assets, rng: np.random.Generator
) -> Scene:
    """Add hard negatives, which differ from an object in height, shade, texture or shape alone.

    Args:
        scene: The scene.
        prob: Probability for each movable object; there may be no room for its hard negative.
        shades: Textures, light and dark, that movable objects may have.
        assets: Source of shapes.
        rng: Source of all draws.
    """
    placements, movable = list(scene.placements), [p for p in scene.placements if not p.fixed]
    for original in movable:
        is_eligible = original.object in _MOVABLE or is_random(original.object)
        if not is_eligible or rng.random() >= prob:
            continue
        position = _free_position(placements, rng)
        kind, negative = _KINDS[rng.integers(len(_KINDS))], None
        if kind == "height":
            x, y, z = original.scale
            stretch = rng.uniform(*_STRETCH)
            factor = stretch if rng.random() < 0.5 else 1 / stretch
            negative = at_rest(replace(original, scale=(x, y, z * factor)), assets)
        elif kind == "shade":
            if shade := _other_shade(original.texture, shades):
                negative = replace(original, texture=shade)
        elif kind == "texture":
            if names := [p.texture for p in movable if p.texture != original.texture]:
                negative = replace(original, texture=names[rng.integers(len(names))])
        elif shapes := [p for p in movable if p.object != original.object]:
            shape = shapes[rng.integers(len(shapes))]
            changed = replace(original, object=shape.object, size=shape.size, scale=shape.scale)
            negative = at_rest(changed, assets)
        if position and negative:
            pose = Pose.planar(*position, rng.uniform(0, 2 * math.pi), z=negative.pose.z)
            placements.append(replace(negative, id=placements[-1].id + 1, pose=pose))
    return replace(scene, placements=tuple(placements))


def _other_shade(texture: str, shades: AbstractSet[str]) -> str | None:
    if is_random(texture):
        return texture.removeprefix("dark ") if texture.startswith("dark ") else f"dark {texture}"
    spec = texture_spec(texture)
    other = spec.light_variant if spec.is_dark else spec.dark_variant
    return other if other in shades else None


def _free_position(placements: Sequence[Placement], rng: np.random.Generator) -> tuple[float, float] | None:
    """Return a position clear of other objects, or None where none was found."""
    for _ in range(_TRIES):
        x, y = rng.uniform(_LOW, _HIGH).tolist()
        distances = [math.hypot(x - p.pose.x, y - p.pose.y) for p in placements]
        if all(d >= _CLEARANCE_M[p.fixed] for d, p in zip(distances, placements, strict=True)):
            return x, y
    return None
