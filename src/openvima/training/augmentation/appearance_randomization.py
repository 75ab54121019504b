"""Scene augmentation of contrastive pretraining: random textures and shapes (domain randomization)."""

from dataclasses import dataclass, replace

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.catalog.partitions import OBJECT_SETS
from openvima.catalog.random_pack import random_name
from openvima.scene import Placement, Pose, Scene

_MOVABLE, _CONTAINERS = OBJECT_SETS["D_shape"], OBJECT_SETS["B_train"]
_PALETTE_SIZE = 3  # random textures of a scene, so that some of its objects share one


@dataclass(frozen=True, slots=True)
class ShapeKinds:
    """How often random shapes are of special kinds; see `PretrainingConfig`."""

    grating_prob: float = 0.0
    eared_prob: float = 0.0
    ring_and_block_prob: float = 0.0

    def of_movable(self, rng: np.random.Generator) -> str:
        """Draw the kind of a movable shape."""
        if not _happens(self.ring_and_block_prob, rng):
            return "shape"
        return "ring" if rng.random() < 0.5 else "block"

    def of_container(self, rng: np.random.Generator) -> str:
        """Draw the kind of a container."""
        if _happens(self.grating_prob, rng):
            return "grating"
        return "eared container" if _happens(self.eared_prob, rng) else "container"


def with_random_appearance(
    scene: Scene, prob: float, assets: Assets, rng: np.random.Generator, kinds: ShapeKinds | None = None
) -> Scene:
    """Give some of the objects a random texture, and some a random shape.

    Args:
        scene: Objects of the training partition; only movable ones and containers get random shapes.
        prob: Probability of either for each object.
        assets: A pack with random textures and shapes.
        rng: Source of all draws.
        kinds: How often which kinds of shapes; none of the special ones by default.
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
            placement = _with_random_shape(placement, assets, rng, common, kinds or ShapeKinds())
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
    kinds: ShapeKinds,
) -> Placement:
    is_container = placement.object in _CONTAINERS
    if not is_container and placement.object not in _MOVABLE:
        return placement
    name = random_name(kinds.of_container(rng) if is_container else kinds.of_movable(rng), rng)
    if common is not None and is_container:
        name = common.setdefault(placement.object, name)
    return at_rest(replace(placement, object=name), assets)


def _happens(prob: float, rng: np.random.Generator) -> bool:
    return bool(prob) and bool(rng.random() < prob)  # draws nothing at 0, so that other draws stay
