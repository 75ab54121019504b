"""The default asset pack: every shape and texture made by code, textures cached on disk."""

import hashlib
import io
import logging
import zlib
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from openvima.atomic_io import atomic_write
from openvima.catalog import images, textures
from openvima.catalog.bodies import build_geometry, has_fixed_size
from openvima.catalog.geometry import Geometry, Vector3, protect
from openvima.catalog.objects import REGISTERED_OBJECTS
from openvima.catalog.registration import registered_geometry, registered_texture
from openvima.catalog.textures import REGISTERED_TEXTURES, texture_spec
from openvima.input_files import cache_dir

_logger = logging.getLogger(__name__)

_CHECKSUM_BYTES = 4  # CRC-32 of all before it; at the end of a file, where readers of .npy ignore it


def cached_array(group: str, key: str, build: Callable[[], np.ndarray]) -> np.ndarray:
    """Read an array from the cache, or build and store it.

    A damaged file is replaced. Without write access the array is built each time.

    Args:
        group: Folder in the cache, with the kind and version of its files.
        key: File name without extension, unique in the group.
        build: Builds the array.
    """
    path = cache_dir() / group / f"{key}.npy"
    try:
        return _read(path)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError, EOFError) as error:
        _logger.warning("%s cannot be read (%s); it will be rebuilt", path, error)
    array = build()
    try:
        _write(path, array)
    except OSError as error:
        _logger.info("%s was not cached: %s", path, error)
    return array


def _read(path: Path) -> np.ndarray:
    content = path.read_bytes()
    body, checksum = content[:-_CHECKSUM_BYTES], content[-_CHECKSUM_BYTES:]
    if zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little") != checksum:
        raise ValueError("its checksum is wrong")
    return np.load(io.BytesIO(body), allow_pickle=False)


def _write(path: Path, array: np.ndarray) -> None:
    """Write atomically, with a checksum."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    body = buffer.getvalue()
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(body)
        file.write(zlib.crc32(body).to_bytes(_CHECKSUM_BYTES, "little"))


_DRAWING_MODULES = (images, textures)
_GEOMETRIES_KEPT = 256  # containers come in any size, so the memory of shapes needs a bound


class ProceduralAssets:
    """Shapes and textures made by code; needs no files. Use `procedural_assets`, which is one per process."""

    name = "procedural"

    def __init__(self) -> None:
        self._textures: dict[str, np.ndarray] = {}
        self._build = lru_cache(maxsize=_GEOMETRIES_KEPT)(_build_protected)

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


def _build_protected(object_name: str, size: Vector3, scale: Vector3) -> Geometry:
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
    files = (__file__, *(str(module.__file__) for module in _DRAWING_MODULES))  # this one: the cache's form
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()[:16]
