"""An asset pack with endlessly many further looks; the name of each holds the seed that it is drawn from."""

import re
from functools import lru_cache

import numpy as np

from openvima.catalog.geometry import Assets, Geometry, Vector3, protect
from openvima.catalog.meshes import scaled_geometry
from openvima.catalog.objects import NO_SYMMETRY, object_spec
from openvima.catalog.random_shapes import has_heading, random_outline, random_shape, random_vessel
from openvima.catalog.random_textures import darkened_texture, random_texture

_NAME = re.compile(r"(dark )?random (texture|shape|vessel) (\d+)")
_NUM_SEEDS = 1 << 31
_KEPT = 64  # shapes and textures that are remembered: those of a few scenes


class RandomLooks:
    """A pack that also knows "random texture 7", "dark random texture 7", "random shape 7" and the like.

    What another pack holds goes through unchanged. Random looks are for images only: nothing collides with
    them, and no task knows them.

    Args:
        base: Where shapes and textures of the catalogue come from.
    """

    def __init__(self, base: Assets) -> None:
        self.base = base
        self._shape = lru_cache(_KEPT)(_drawn_shape)
        self._texture = lru_cache(_KEPT)(_drawn_texture)

    @property
    def name(self) -> str:
        """Name of the pack."""
        return f"{self.base.name} and random looks"

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return a shape; see `Assets.geometry`. Random shapes have one size and ignore `size`."""
        if is_random(object_name):
            return self._shape(object_name, scale)
        return self.base.geometry(object_name, size, scale)

    def texture(self, texture_name: str) -> np.ndarray:
        """Return a texture's image; see `Assets.texture`."""
        return self._texture(texture_name) if is_random(texture_name) else self.base.texture(texture_name)


def random_name(kind: str, rng: np.random.Generator) -> str:
    """Draw the name of a "texture", "shape" or "vessel"."""
    return f"random {kind} {int(rng.integers(_NUM_SEEDS))}"


def is_random(name: str) -> bool:
    """Whether a name is that of a random look."""
    return _NAME.fullmatch(name) is not None


@lru_cache(1024)
def shows_heading(object_name: str) -> bool:
    """Whether a shape looks different at every yaw, so that two images of it tell how it was turned."""
    if not is_random(object_name):
        return object_spec(object_name).symmetry_rad == NO_SYMMETRY
    kind, rng = _read(object_name)
    return kind == "shape" and has_heading(random_outline(rng))


def _read(name: str) -> tuple[str, np.random.Generator]:
    match = _NAME.fullmatch(name)
    assert match is not None, name
    return match[2], np.random.default_rng(int(match[3]))


def _drawn_shape(name: str, scale: Vector3) -> Geometry:
    kind, rng = _read(name)
    drawn = random_shape(rng) if kind == "shape" else random_vessel(rng)
    return protect(scaled_geometry(drawn, scale))


def _drawn_texture(name: str) -> np.ndarray:
    _, rng = _read(name)
    image = random_texture(rng)
    image = darkened_texture(image) if name.startswith("dark ") else image
    image.setflags(write=False)
    return image
