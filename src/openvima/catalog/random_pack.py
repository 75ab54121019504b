"""An asset pack with random shapes and textures, whose names contain their seeds."""

import re
from functools import lru_cache

import numpy as np

from openvima.catalog.geometry import Assets, Geometry, Vector3, protect
from openvima.catalog.meshes import scaled_geometry
from openvima.catalog.objects import NO_SYMMETRY, object_spec
from openvima.catalog.random_shapes import (
    has_heading,
    random_block,
    random_container,
    random_eared_container,
    random_grating,
    random_outline,
    random_ring,
    random_round_container,
    random_shape,
    random_square_container,
)
from openvima.catalog.random_textures import darkened_texture, random_texture

_SHAPES = {
    "shape": random_shape,
    "ring": random_ring,
    "block": random_block,
    "container": random_container,
    "grating": random_grating,
    "eared container": random_eared_container,
    "square container": random_square_container,
    "round container": random_round_container,
}
_NAME = re.compile(rf"(dark )?random (texture|{'|'.join(_SHAPES)}) (\d+)")
_NUM_SEEDS = 1 << 31
_KEPT = 64  # cached shapes and textures: those of a few scenes


class RandomAppearanceAssets:
    """A pack that adds "random texture 7", "dark random texture 7", "random shape 7" and so on to another.

    Random shapes are for images only: they have no collision, and no task uses them.

    Args:
        base: Pack of the catalogue's shapes and textures.
        num_kept: Random shapes and textures to cache, of each kind; 30 and 50 kB each.
    """

    def __init__(self, base: Assets, num_kept: int = _KEPT) -> None:
        self.base = base
        self._plain_shape = lru_cache(num_kept)(_drawn_shape)
        self._shape = lru_cache(_KEPT)(self._stretched)
        self._texture = lru_cache(num_kept)(_drawn_texture)

    @property
    def name(self) -> str:
        """Name of the pack."""
        return f"{self.base.name} and random appearance"

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return a shape; see `Assets.geometry`. Random shapes have one size and ignore `size`."""
        if is_random(object_name):
            return self._shape(object_name, scale)
        return self.base.geometry(object_name, size, scale)

    def texture(self, texture_name: str) -> np.ndarray:
        """Return a texture's image; see `Assets.texture`."""
        return self._texture(texture_name) if is_random(texture_name) else self.base.texture(texture_name)

    def _stretched(self, name: str, scale: Vector3) -> Geometry:
        return protect(scaled_geometry(self._plain_shape(name), scale))


def random_name(kind: str, rng: np.random.Generator, pool: range = range(_NUM_SEEDS)) -> str:
    """Draw the name of a "texture", or of a kind of shape, such as "shape", "container" or "grating".

    Args:
        kind: The kind.
        rng: Generator of the draw.
        pool: Seeds to draw from; a few of them can be cached.
    """
    return f"random {kind} {int(rng.integers(pool.start, pool.stop))}"


def is_random(name: str) -> bool:
    """Whether a name is that of a random shape or texture."""
    return _NAME.fullmatch(name) is not None


@lru_cache(4096)
def has_visible_heading(object_name: str) -> bool:
    """Whether the yaw of a shape is visible: it has no rotational symmetry."""
    if not is_random(object_name):
        return object_spec(object_name).symmetry_rad == NO_SYMMETRY
    kind, rng = _read(object_name)
    return kind == "shape" and has_heading(random_outline(rng))


def _read(name: str) -> tuple[str, np.random.Generator]:
    match = _NAME.fullmatch(name)
    assert match is not None, name
    return match[2], np.random.default_rng(int(match[3]))


def _drawn_shape(name: str) -> Geometry:
    kind, rng = _read(name)
    return protect(_SHAPES[kind](rng))


def _drawn_texture(name: str) -> np.ndarray:
    _, rng = _read(name)
    image = random_texture(rng)
    image = darkened_texture(image) if name.startswith("dark ") else image
    image.setflags(write=False)
    return image
