"""The original asset pack: meshes, textures and collision shapes of VIMA-Bench."""

import io
from functools import lru_cache
from pathlib import Path

import numpy as np

from openvima.catalog.bodies import BOX_SHAPES
from openvima.catalog.cache import cached_array
from openvima.catalog.geometry import CollisionHull, Geometry, TriangleMesh, Vector3, protect
from openvima.catalog.hanoi import LONG_RODS_Z, hanoi_stand
from openvima.catalog.meshes import scaled_geometry
from openvima.catalog.obj_file import ObjMesh, parse_obj
from openvima.catalog.objects import REGISTERED_OBJECTS, ObjectSpec, object_spec
from openvima.catalog.pack_files import CheckoutFiles, PackFiles, known_hashes
from openvima.catalog.registration import registered_geometry, registered_texture
from openvima.catalog.textures import REGISTERED_TEXTURES, TextureSpec, texture_spec
from openvima.errors import AssetError

# Scales of meshes of fixed size, metres per mesh unit, and the height at which their origin rests.
_FIXED_MESHES: dict[str, tuple[str, Vector3, float]] = {
    "bowl": ("bowl/textured-0008192.obj", (2.2, 2.2, 0.5), 0.0),
    "pallet": ("pallet/pallet.obj", (0.175, 0.175, 0.175), 0.0131),
    "frame": ("zone/zone.obj", (0.009, 0.009, 0.000075), 0.0),
    "pan": ("google/meshes_fixed/frypan.obj", (0.825, 0.825, 0.825 / 1.1), 0.0137),
    "disk": ("hanoi/disk0.obj", (0.0015, 0.0015, 0.003), 0.015),
}
_BOWL_PARTS = ("bowl/cup.obj", (2.2, 2.2, 0.4))  # 14 convex parts, a fifth flatter than what is drawn
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
# Decoded once and cached: JPEG decoders differ by a level or two.
_IMAGE_GROUP, _MESH_GROUP = "original-images-2", "original-meshes-1"
_PATTERN_FOLDERS = {
    "stripe": ("stripes", "stripe"),
    "polka_dot_2": ("polka_dots", "polka_dot"),
    "swirl": ("swirls", "swirl"),
    "paisley": ("paisleys", "paisley"),
}


class OriginalAssets:
    """The shapes and textures of VIMA-Bench; implements `Assets`.

    Args:
        source: Folder of a checkout of VIMA-Bench, its assets folder, or the files of a pack.

    Raises:
        AssetError: The folder contains no asset pack.
    """

    name = "original"

    def __init__(self, source: "str | Path | PackFiles") -> None:
        self.files = CheckoutFiles.within(source) if isinstance(source, str | Path) else source

    def __repr__(self) -> str:
        return f"OriginalAssets({self.files!r})"

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return the shape of a catalogue object; see `Assets.geometry`.

        Raises:
            UnknownObjectError: The catalogue has no such object.
            AssetError: A mesh is missing or damaged.
        """
        if object_name in REGISTERED_OBJECTS:
            return registered_geometry(object_name, size, scale)
        return _protected_geometry(self.files, object_name, size, scale)

    def texture(self, texture_name: str) -> np.ndarray:
        """Return the texture's image, shape (H, W, 3), uint8; see `Assets.texture`.

        Raises:
            UnknownTextureError: The catalogue has no such texture.
            AssetError: The image is missing or damaged.
        """
        if texture_name in REGISTERED_TEXTURES:
            return registered_texture(texture_name)
        return _protected_texture(self.files, texture_name)

    def problems(self) -> list[str]:
        """Check every file of the pack.

        Returns:
            One sentence for each file that is missing or differs from the original; empty if all is well.
        """
        found = []
        for relative_path in known_hashes():
            try:
                self.files.read(relative_path)
            except AssetError as error:
                found.append(str(error))
        return found


def decode_file(files: PackFiles, relative_path: str) -> None:
    """Check a file of the pack and decode it into the cache, if it is one to be decoded.

    The body descriptions (.urdf) are checked only: the catalogue states their few numbers.

    Raises:
        AssetError: The file is missing or damaged, or cannot be decoded.
    """
    if relative_path.endswith(".obj"):
        _mesh(files, relative_path)
    elif relative_path.startswith("textures/"):
        _image(files, relative_path)
    else:
        files.read(relative_path)


@lru_cache(maxsize=256)
def _protected_geometry(files: PackFiles, object_name: str, size: Vector3, scale: Vector3) -> Geometry:
    spec = object_spec(object_name)
    try:
        return protect(_geometry(files, spec, size, scale))
    except AssetError as error:
        raise AssetError(f"object {object_name!r} cannot be used: {error}") from error


def _geometry(files: PackFiles, spec: ObjectSpec, size: Vector3, scale: Vector3) -> Geometry:
    if spec.name in BOX_SHAPES:
        return BOX_SHAPES[spec.name][0](_product(size, scale))
    if spec.kind == "kit":
        return _kit(files, spec, scale)
    if spec.name == "stand":  # which has no mesh file
        return scaled_geometry(hanoi_stand(LONG_RODS_Z), scale)
    return _fixed_mesh(files, spec.name, scale)


def _kit(files: PackFiles, spec: ObjectSpec, scale: Vector3) -> Geometry:
    kit_scale = spec.kit_scale or 1.0
    metres = _product((0.003 * kit_scale, 0.003 * kit_scale, 0.001 * kit_scale / 1.1), scale)
    name = spec.name.replace("letter", "capital letter").replace("L-shaped block", "right angle")
    visual = _scaled(_mesh(files, f"kitting/{name.lower().replace(' ', '_')}.obj"), metres)
    return Geometry(visual, (_hull(visual.vertices),), 0.0)


def _fixed_mesh(files: PackFiles, object_name: str, scale: Vector3) -> Geometry:
    file, metres, rest_z_m = _FIXED_MESHES[object_name]
    visual = _scaled(_mesh(files, file), _product(metres, scale))
    collision = (_hull(visual.vertices),)
    if object_name == "bowl":
        parts_file, parts_metres = _BOWL_PARTS
        parts = _mesh(files, parts_file)
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
def _mesh(files: PackFiles, relative_path: str) -> ObjMesh:
    content = files.read(relative_path)

    def parsed() -> np.ndarray:
        return parse_obj(content.decode("utf-8", errors="replace"), relative_path).to_array()

    return ObjMesh.from_array(cached_array(_MESH_GROUP, _cache_key(relative_path), parsed))


@lru_cache(maxsize=128)
def _protected_texture(files: PackFiles, texture_name: str) -> np.ndarray:
    spec = texture_spec(texture_name)
    if spec.texel is not None:
        texture = np.array(spec.texel, dtype=np.uint8).reshape(1, 1, 3)
    else:
        try:
            texture = _image(files, image_file(spec))
        except AssetError as error:
            raise AssetError(f"texture {texture_name!r} cannot be used: {error}") from error
    texture.setflags(write=False)
    return texture


def _image(files: PackFiles, relative_path: str) -> np.ndarray:
    content = files.read(relative_path)
    return cached_array(_IMAGE_GROUP, _cache_key(relative_path), lambda: _decoded(content, relative_path))


def _cache_key(relative_path: str) -> str:
    return known_hashes()[relative_path][:32]


def _decoded(content: bytes, relative_path: str) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(io.BytesIO(content)) as image:
            return np.array(image.convert("RGB"))
    except (UnidentifiedImageError, OSError) as error:
        raise AssetError(
            f"{relative_path} cannot be decoded ({error}); is Pillow installed with support for it?"
        ) from error


def image_file(texture: TextureSpec) -> str:
    """Return where the pack keeps the image of a texture that is no plain colour, relative to the pack."""
    light = texture.light_variant
    if light in _SPECIAL_IMAGES:
        return f"textures/{_SPECIAL_IMAGES[light]}"
    subfolder, suffix = _PATTERN_FOLDERS[texture.category]
    stem = "_".join([*(["dark"] if texture.is_dark else []), *texture.base_colours, suffix])
    return f"textures/{subfolder}/{stem}.jpg"
