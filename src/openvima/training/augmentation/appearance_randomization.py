"""Scene augmentation of contrastive pretraining: random textures and shapes (domain randomization)."""

from dataclasses import replace

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.catalog.partitions import OBJECT_SETS
from openvima.catalog.random_pack import random_name
from openvima.scene import Placement, Pose, Scene

_MOVABLE, _CONTAINERS = OBJECT_SETS["D_shape"], OBJECT_SETS["B_train"]
_PALETTE_SIZE = 3  # random textures of a scene, so that some of its objects share one


def with_random_appearance(
    scene: Scene, prob: float, assets: Assets, rng: np.random.Generator, grating_prob: float = 0.0
) -> Scene:
    """Give some of the objects a random texture, and some a random shape.

    Args:
        scene: Objects of the training partition; only movable ones and containers get random shapes.
        prob: Probability of either for each object.
        assets: A pack with random textures and shapes.
        rng: Source of all draws.
        grating_prob: Probability that a random container is a grating.
    """
    palette = [random_name("texture", rng) for _ in range(_PALETTE_SIZE)]
    # In half of the scenes equal containers stay equal, so that only texture distinguishes them.
    common = {} if rng.random() < 0.5 else None
    placements = []
    for placement in scene.placements:
        if rng.random() < prob:
            dark = "dark " if rng.random() < 0.25 else ""
            placement = replace(placement, texture=dark + palette[int(rng.integers(_PALETTE_SIZE))])
        if rng.random() < prob:
            placement = _with_random_shape(placement, assets, rng, common, grating_prob)
        placements.append(placement)
    return replace(scene, placements=tuple(placements))


def at_rest(placement: Placement, assets: Assets) -> Placement:
    """Put an object on the table at the height of its own shape."""
    height = assets.geometry(placement.object, placement.size, placement.scale).rest_z_m
    return placement.at(Pose((placement.pose.x, placement.pose.y, height), placement.pose.quaternion))


def _with_random_shape(
    placement: Placement,
    assets: Assets,
    rng: np.random.Generator,
    common: dict[str, str] | None,
    grating_prob: float,
) -> Placement:
    if placement.object in _MOVABLE:
        kind = "shape"
    elif placement.object in _CONTAINERS:
        kind = "grating" if grating_prob and rng.random() < grating_prob else "container"
    else:
        return placement
    name = random_name(kind, rng)
    if common is not None and kind != "shape":
        name = common.setdefault(placement.object, name)
    return at_rest(replace(placement, object=name), assets)
