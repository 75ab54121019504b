"""Scene augmentation of contrastive pretraining: neighbours that differ from an object in one respect."""

import math
from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from dataclasses import replace

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.catalog.partitions import OBJECT_SETS
from openvima.catalog.random_pack import is_random
from openvima.catalog.textures import texture_spec
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Placement, Pose, Scene
from openvima.training.augmentation.appearance_randomization import at_rest
from openvima.training.augmentation.rearranged_view import EDGE_M

_MOVABLE = OBJECT_SETS["D_shape"]
_KINDS = ("height", "shade", "texture", "shape")
_STRETCH = (1.35, 2.2)  # ratio of heights
_TRIES = 20
_CLEARANCE_M = 0.12


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
    placements = list(scene.placements)
    for original in scene.placements:
        is_eligible = original.object in _MOVABLE or is_random(original.object)
        if original.fixed or not is_eligible or rng.random() >= prob:
            continue
        position = _free_position(placements, rng)
        kind = _KINDS[int(rng.integers(len(_KINDS)))]
        negative = _changed(original, kind, scene.placements, shades, assets, rng)
        if position and negative:
            pose = Pose.planar(*position, rng.uniform(0, 2 * math.pi), z=negative.pose.z)
            placements.append(replace(negative, id=placements[-1].id + 1, pose=pose))
    return replace(scene, placements=tuple(placements))


def _changed(
    original: Placement,
    kind: str,
    others: Sequence[Placement],
    shades: AbstractSet[str],
    assets: Assets,
    rng: np.random.Generator,
) -> Placement | None:
    """Return the object changed in one respect; None where that is impossible."""
    if kind == "height":
        x, y, z = original.scale
        stretch = rng.uniform(*_STRETCH)
        factor = stretch if rng.random() < 0.5 else 1 / stretch
        return at_rest(replace(original, scale=(x, y, z * factor)), assets)
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
    return at_rest(replace(original, object=shape.object, size=shape.size, scale=shape.scale), assets)


def _other_shade(texture: str, shades: AbstractSet[str]) -> str | None:
    if is_random(texture):
        return texture.removeprefix("dark ") if texture.startswith("dark ") else f"dark {texture}"
    spec = texture_spec(texture)
    other = spec.light_variant if spec.is_dark else spec.dark_variant
    return other if other in shades else None


def _free_position(placements: Sequence[Placement], rng: np.random.Generator) -> tuple[float, float] | None:
    """Return a position clear of other objects, or None where none was found."""
    low, high = np.array(WORKSPACE_LOW) + EDGE_M, np.array(WORKSPACE_HIGH) - EDGE_M
    for _ in range(_TRIES):
        x, y = rng.uniform(low, high).tolist()
        if all(math.hypot(x - p.pose.x, y - p.pose.y) >= _clearance(p) for p in placements):
            return x, y
    return None


def _clearance(placement: Placement) -> float:
    return _CLEARANCE_M + (0.06 if placement.fixed else 0.0)
