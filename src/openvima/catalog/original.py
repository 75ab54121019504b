"""The original asset pack, read from a checkout of VIMA-Bench: meshes, textures and body shapes.

With it, images are those of the benchmark. The files are checked against known hashes, so that a pack which
is incomplete or differs is reported instead of giving other pixels.
"""

import hashlib
import io
import json
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from openvima.catalog import boxes
from openvima.catalog.cache import cached_array
from openvima.catalog.geometry import CollisionHull, Geometry, TriangleMesh, Vector3, protect
from openvima.catalog.obj_file import ObjMesh, parse_obj
from openvima.catalog.objects import ObjectSpec, object_spec
from openvima.catalog.textures import TextureSpec, texture_spec
from openvima.errors import AssetError

PACK_FOLDER = Path("vima_bench/tasks/assets")  # inside a checkout
_KIT_FILES = {
    "letter A": "capital_letter_a",
    "letter E": "capital_letter_e",
    "letter G": "capital_letter_g",
    "letter M": "capital_letter_m",
    "letter R": "capital_letter_r",
    "letter T": "capital_letter_t",
    "letter V": "capital_letter_v",
    "cross": "cross",
    "diamond": "diamond",
    "triangle": "triangle",
    "flower": "flower",
    "heart": "heart",
    "hexagon": "hexagon",
    "pentagon": "pentagon",
    "L-shaped block": "right_angle",
    "ring": "ring",
    "round": "round",
    "star": "star",
}
# Scales of meshes of fixed size, metres per mesh unit, and the height at which their origin rests.
_FIXED_MESHES: dict[str, tuple[str, Vector3, float]] = {
    "bowl": ("bowl/textured-0008192.obj", (2.2, 2.2, 0.5), 0.0),
    "pallet": ("pallet/pallet.obj", (0.175, 0.175, 0.175), 0.0131),
    "frame": ("zone/zone.obj", (0.009, 0.009, 0.000075), 0.0),
    "pan": ("google/meshes_fixed/frypan.obj", (0.825, 0.825, 0.825 / 1.1), 0.0137),
}
_BOWL_PARTS = ("bowl/cup.obj", (2.2, 2.2, 0.4))  # 14 convex parts, a fifth flatter than what is drawn
_BOX_SHAPES: dict[str, Callable[[Vector3], Geometry]] = {
    "block": boxes.block,
    "shorter block": boxes.block,
    "small block": boxes.block,
    "line": boxes.line,
    "container": boxes.container,
    "square": boxes.square,
    "three-sided rectangle": boxes.three_sided_rectangle,
}
_SPECIAL_IMAGES = {
    "brick": "brick.jpg",
    "tiles": "tiles.jpg",
    "wooden": "wood_light.png",
    "granite": "granite.png",
    "plastic": "plastic.jpg",
    "polka dot": "polka_dot.jpg",
    "checkerboard": "checkerboard.png",
    "tiger": "tiger.jpg",
    "magma": "magma.jpg",
    "rainbow": "rainbow.jpg",
}
_DECODED_GROUP = "original-textures-1"
_PATTERN_FOLDERS = {
    "stripe": ("stripes", "stripe"),
    "polka_dot_2": ("polka_dots", "polka_dot"),
    "swirl": ("swirls", "swirl"),
    "paisley": ("paisleys", "paisley"),
}


class OriginalAssets:
    """The shapes and textures of a checkout of VIMA-Bench; implements `Assets`.

    Args:
        checkout: Folder of the checkout (it holds `vima_bench/tasks/assets`), or that assets folder itself.

    Raises:
        AssetError: The folder holds no asset pack.
    """

    name = "original"

    def __init__(self, checkout: str | Path) -> None:
        checkout = Path(checkout)
        candidates = (checkout / PACK_FOLDER, checkout)
        folder = next((path for path in candidates if (path / "textures").is_dir()), None)
        if folder is None:
            raise AssetError(
                f"{checkout} holds no original asset pack ({PACK_FOLDER}/textures is missing); "
                "give the folder of a VIMABench checkout."
            )
        self.folder = folder.resolve()

    def __repr__(self) -> str:
        return f"OriginalAssets({str(self.folder)!r})"

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return the shape of a catalogue object; see `Assets.geometry`.

        Raises:
            UnknownObjectError: The catalogue has no such object.
            AssetError: A mesh is missing or damaged, or no task uses the object.
        """
        return _protected_geometry(self.folder, object_name, size, scale)

    def texture(self, texture_name: str) -> np.ndarray:
        """Return the texture's image, shape (H, W, 3), uint8; see `Assets.texture`.

        Raises:
            UnknownTextureError: The catalogue has no such texture.
            AssetError: The image is missing or damaged.
        """
        return _protected_texture(self.folder, texture_name)

    def problems(self) -> list[str]:
        """Check every file of the pack that tasks use.

        Returns:
            One sentence for each file that is missing or differs from the original; empty if all is well.
        """
        found = []
        for relative_path in _known_hashes():
            try:
                _read(self.folder, relative_path)
            except AssetError as error:
                found.append(str(error))
        return found


@lru_cache(maxsize=1024)
def _protected_geometry(folder: Path, object_name: str, size: Vector3, scale: Vector3) -> Geometry:
    return protect(_geometry(folder, object_name, size, scale))


def _geometry(folder: Path, object_name: str, size: Vector3, scale: Vector3) -> Geometry:
    spec = object_spec(object_name)
    if object_name in _BOX_SHAPES:
        return _BOX_SHAPES[object_name](_product(size, scale))
    if object_name in _KIT_FILES:
        return _kit(folder, spec, scale)
    if object_name in _FIXED_MESHES:
        return _fixed_mesh(folder, object_name, scale)
    raise AssetError(f"object {object_name!r} is used by no task and not imported from the original pack.")


def _kit(folder: Path, spec: ObjectSpec, scale: Vector3) -> Geometry:
    kit_scale = spec.kit_scale or 1.0
    metres = _product((0.003 * kit_scale, 0.003 * kit_scale, 0.001 * kit_scale / 1.1), scale)
    visual = _scaled(_mesh(folder, f"kitting/{_KIT_FILES[spec.name]}.obj"), metres)
    return Geometry(visual, (_hull(visual.vertices),), 0.0)


def _fixed_mesh(folder: Path, object_name: str, scale: Vector3) -> Geometry:
    file, metres, rest_z_m = _FIXED_MESHES[object_name]
    visual = _scaled(_mesh(folder, file), _product(metres, scale))
    collision = (_hull(visual.vertices),)
    if object_name == "bowl":
        parts_file, parts_metres = _BOWL_PARTS
        parts = _mesh(folder, parts_file)
        vertices = parts.vertices * _product(parts_metres, scale)
        collision = tuple(_hull(vertices[parts.parts == part]) for part in np.unique(parts.parts))
    return Geometry(visual, collision, rest_z_m * scale[2])


def _scaled(mesh: ObjMesh, metres: Vector3) -> TriangleMesh:
    """Scale positions only: the benchmark lights every mesh with the normals of its file."""
    return TriangleMesh(mesh.vertices * np.array(metres), mesh.normals, mesh.uvs)


def _hull(vertices: np.ndarray) -> CollisionHull:
    return CollisionHull(np.unique(vertices.reshape(-1, 3), axis=0))


def _product(a: Vector3, b: Vector3) -> Vector3:
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@lru_cache(maxsize=64)
def _mesh(folder: Path, relative_path: str) -> ObjMesh:
    text = _read(folder, relative_path).decode("utf-8", errors="replace")
    return parse_obj(text, str(folder / relative_path))


@lru_cache(maxsize=128)
def _protected_texture(folder: Path, texture_name: str) -> np.ndarray:
    texture = _texture(folder, texture_name)
    texture.setflags(write=False)
    return texture


def _texture(folder: Path, texture_name: str) -> np.ndarray:
    spec = texture_spec(texture_name)
    if spec.texel is not None:
        return np.array(spec.texel, dtype=np.uint8).reshape(1, 1, 3)
    relative_path = image_file(spec)
    content = _read(folder, relative_path)
    # Decoders of JPEG files differ by a level or two: what was decoded once stays.
    return cached_array(
        _DECODED_GROUP, _known_hashes()[relative_path][:32], lambda: _decoded(content, folder / relative_path)
    )


def _decoded(content: bytes, path: Path) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(content)) as image:
            return np.array(image.convert("RGB"))
    except (UnidentifiedImageError, OSError) as error:
        raise AssetError(f"{path} cannot be decoded ({error}); restore the file.") from error


def image_file(texture: TextureSpec) -> str:
    """Return where the pack keeps the image of a texture that is no plain colour, relative to the pack."""
    light = texture.light_variant
    if light in _SPECIAL_IMAGES:
        return f"textures/{_SPECIAL_IMAGES[light]}"
    subfolder, suffix = _PATTERN_FOLDERS[texture.category]
    stem = "_".join([*(["dark"] if texture.is_dark else []), *texture.base_colours, suffix])
    return f"textures/{subfolder}/{stem}.jpg"


def _read(folder: Path, relative_path: str) -> bytes:
    """Read a file of the pack and make sure that it is the original one."""
    path = folder / relative_path
    try:
        content = path.read_bytes()
    except OSError as error:
        raise AssetError(f"{path} is missing or unreadable; complete the checkout of VIMABench.") from error
    if hashlib.sha256(content).hexdigest() != _known_hashes()[relative_path]:
        raise AssetError(
            f"{path} differs from the file of the original benchmark (damaged, or another version); "
            "restore it from a fresh checkout of VIMABench."
        )
    return content


@lru_cache(maxsize=1)
def _known_hashes() -> dict[str, str]:
    """SHA-256 of the 88 files that tasks use, by path in the pack."""
    return json.loads(Path(__file__).with_name("original_files.json").read_text(encoding="utf-8"))
