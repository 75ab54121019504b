"""Packs of the catalogue; in the default one shapes are made by code, and images are part of the package."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from openvima.catalog.bodies import BOX_SHAPES, build_geometry
from openvima.catalog.geometry import Geometry, Vector3, protect
from openvima.catalog.objects import REGISTERED_OBJECTS
from openvima.catalog.registration import registered_geometry, registered_texture
from openvima.catalog.textures import REGISTERED_TEXTURES, texture_spec

# One a texture that is no plain colour, in layout and mean colour like that of the original.
_IMAGES = Path(__file__).with_name("images")


class CataloguePack(ABC):
    """Shapes and textures of the catalogue from one source, and those that users register."""

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return the shape of a catalogue object; see `Assets.geometry`."""
        if object_name in REGISTERED_OBJECTS:
            return registered_geometry(object_name, size, scale)
        if object_name not in BOX_SHAPES:
            size = (0.0, 0.0, 0.0)  # which the others ignore: one entry for all sizes
        return _shared_geometry(self, object_name, size, scale)

    def texture(self, texture_name: str) -> np.ndarray:
        """Return the texture's image; see `Assets.texture`."""
        if texture_name in REGISTERED_TEXTURES:
            return registered_texture(texture_name)
        return _shared_texture(self, texture_name)

    @abstractmethod
    def build(self, object_name: str, size: Vector3, scale: Vector3) -> Geometry:
        """Build a shape, as `geometry` returns it."""

    @abstractmethod
    def load_image(self, texture_name: str) -> np.ndarray:
        """Load the image of a texture that is no plain colour, as `texture` returns it."""


@lru_cache(maxsize=256)  # containers come in any size, so the memory of shapes needs a bound
def _shared_geometry(pack: CataloguePack, object_name: str, size: Vector3, scale: Vector3) -> Geometry:
    return protect(pack.build(object_name, size, scale))


@lru_cache(maxsize=256)
def _shared_texture(pack: CataloguePack, texture_name: str) -> np.ndarray:
    texel = texture_spec(texture_name).texel
    texture = pack.load_image(texture_name) if texel is None else np.array([[texel]], np.uint8)
    texture.setflags(write=False)
    return texture


class ProceduralAssets(CataloguePack):
    """The default pack. Use `procedural_assets`, which is one per process."""

    name = "procedural"

    def __reduce__(self) -> tuple[Callable[[], "ProceduralAssets"], tuple[()]]:
        return procedural_assets, ()

    def build(self, object_name: str, size: Vector3, scale: Vector3) -> Geometry:
        """Build a shape by code."""
        return build_geometry(object_name, size, scale)

    def load_image(self, texture_name: str) -> np.ndarray:
        """Load the image that is part of the package."""
        from PIL import Image  # scenes of plain colours do without

        with Image.open(_IMAGES / f"{texture_name.replace(' ', '_')}.png") as image:
            return np.array(image.convert("RGB"))


@cache
def procedural_assets() -> ProceduralAssets:
    """Return the default pack of this process."""
    return ProceduralAssets()
