"""The default asset pack: shapes made by code, and the images of textures, which are part of the package."""

from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from openvima.catalog.bodies import build_geometry, has_fixed_size
from openvima.catalog.geometry import Geometry, Vector3, protect
from openvima.catalog.objects import REGISTERED_OBJECTS
from openvima.catalog.registration import registered_geometry, registered_texture
from openvima.catalog.textures import REGISTERED_TEXTURES, texture_spec

# One a texture that is no plain colour, in layout and mean colour like that of the original.
_IMAGES = Path(__file__).with_name("images")


class ProceduralAssets:
    """The pack of the package. Use `procedural_assets`, which is one per process."""

    name = "procedural"

    def __reduce__(self) -> tuple[Callable[[], "ProceduralAssets"], tuple[()]]:
        return procedural_assets, ()

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return the shape of a catalogue object; see `Assets.geometry`."""
        if object_name in REGISTERED_OBJECTS:
            return registered_geometry(object_name, size, scale)
        if has_fixed_size(object_name):
            size = (0.0, 0.0, 0.0)  # one entry for all sizes
        return _build(object_name, size, scale)

    def texture(self, texture_name: str) -> np.ndarray:
        """Return the texture's image; see `Assets.texture`."""
        if texture_name in REGISTERED_TEXTURES:
            return registered_texture(texture_name)
        return _load_texture(texture_name)


@cache
def procedural_assets() -> ProceduralAssets:
    """Return the pack of this process."""
    return ProceduralAssets()


@lru_cache(maxsize=256)  # containers come in any size, so the memory of shapes needs a bound
def _build(object_name: str, size: Vector3, scale: Vector3) -> Geometry:
    return protect(build_geometry(object_name, size, scale))


@cache
def _load_texture(texture_name: str) -> np.ndarray:
    spec = texture_spec(texture_name)
    if spec.texel is not None:
        texture = np.array(spec.texel, np.uint8).reshape(1, 1, 3)
    else:
        from PIL import Image  # scenes of plain colours do without

        with Image.open(_IMAGES / f"{texture_name.replace(' ', '_')}.png") as image:
            texture = np.array(image.convert("RGB"))
    texture.setflags(write=False)
    return texture
