"""The default asset pack: every shape and texture made by code."""

import hashlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from openvima.catalog import cache, images, materials, noise, patterns, textures
from openvima.catalog.bodies import build_geometry, has_fixed_size
from openvima.catalog.cache import cached_array
from openvima.catalog.geometry import Geometry, Vector3, protect
from openvima.catalog.objects import REGISTERED_OBJECTS
from openvima.catalog.registration import registered_geometry, registered_texture
from openvima.catalog.textures import REGISTERED_TEXTURES, texture_spec

_DRAWING_MODULES = (cache, images, materials, noise, patterns, textures)  # cache: the form of its files
_GEOMETRIES_KEPT = 256  # containers come in any size, so the memory of shapes needs a bound


class ProceduralAssets:
    """Shapes and textures made by code; needs no files. Use `procedural_assets`, which is one per process."""

    name = "procedural"

    def __init__(self) -> None:
        self._textures: dict[str, np.ndarray] = {}
        self._build = lru_cache(maxsize=_GEOMETRIES_KEPT)(_built)

    def __reduce__(self) -> tuple[Callable[[], "ProceduralAssets"], tuple[()]]:
        return procedural_assets, ()

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return the shape of a catalogue object; see `Assets.geometry`."""
        if object_name in REGISTERED_OBJECTS:
            return registered_geometry(object_name, size, scale)
        if has_fixed_size(object_name):
            size = (0.0, 0.0, 0.0)  # one entry for all sizes
        return self._build(object_name, size, scale)

    def texture(self, texture_name: str) -> np.ndarray:
        """Return the texture's image; see `Assets.texture`."""
        if texture_name in REGISTERED_TEXTURES:
            return registered_texture(texture_name)
        if texture_name not in self._textures:
            texture = _load_texture(texture_name)
            texture.setflags(write=False)
            self._textures[texture_name] = texture
        return self._textures[texture_name]


@lru_cache(maxsize=1)
def procedural_assets() -> ProceduralAssets:
    """Return the pack of this process, which remembers what it made."""
    return ProceduralAssets()


def _built(object_name: str, size: Vector3, scale: Vector3) -> Geometry:
    return protect(build_geometry(object_name, size, scale))


def _load_texture(texture_name: str) -> np.ndarray:
    spec = texture_spec(texture_name)
    if spec.colour is not None:
        return images.draw_texture(texture_name)
    group = f"procedural-textures-{_drawing_version()}"
    return cached_array(group, spec.id.lower(), lambda: images.draw_texture(texture_name))


@lru_cache(maxsize=1)
def _drawing_version() -> str:
    """Digest of the drawing code: a change to it makes the cached images unused."""
    digest = hashlib.sha256()
    for module in _DRAWING_MODULES:
        digest.update(Path(str(module.__file__)).read_bytes())
    return digest.hexdigest()[:16]
