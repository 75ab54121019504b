"""Objects and textures of users, by name, beside those of the catalogue."""

import hashlib
import math
import re
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from openvima.catalog.geometry import Geometry, Vector3, product, protect
from openvima.catalog.mesh_files import Mesh, UserMesh, check_lengths, read_mesh
from openvima.catalog.objects import OBJECTS, REGISTERED_OBJECTS, ObjectSpec, Profile
from openvima.catalog.textures import NEUTRAL_TEXTURE, REGISTERED_TEXTURES, TEXTURES, TextureSpec
from openvima.errors import AssetError, InputFileError, ShapeError, echo
from openvima.input_files import as_path, read_png

MAX_TEXTURE_SIDE = 1024  # pixels
MAX_PNG_BYTES = 8 << 20
_NAME = re.compile(r"(?:[^\W_]|['-])+(?: (?:[^\W_]|['-])+)*")
_MASS_KG = (0.001, 2.0)
_FRICTION = (0.05, 1.0)  # as in the catalogue, none exceeds 1; see `sim.model`


# Of each "object" or "texture" by name: a digest that tells whether another one is equal, and mesh or image.
_CONTENTS: dict[tuple[str, str], tuple[str, Any]] = {}


def register_object(
    name: str,
    mesh: Mesh,
    *,
    size: Vector3 | None = None,
    size_max: Vector3 | None = None,
    symmetry_deg: float = 360.0,
    profile: Profile | None = None,
    aliases: Sequence[str] = (),
    collision: Mesh | None = None,
    double_sided: bool = False,
    mass_kg: float = 0.1,
    friction: float = 1.0,
) -> ObjectSpec:
    """Register an object of your own. Registering an equal one again changes nothing.

    Args:
        name: Its name in prompts, scenes and pools, such as "toy car".
        mesh: An OBJ file, or a pair of vertices, shape (V, 3), and triangles, shape (F, 3): counter-clockwise
            seen from outside, z up. Its middle becomes the origin of the object.
        size: Lengths of its bounding box in metres, to which the mesh is scaled; with `size_max` the smallest
            ones. None: the mesh is in metres.
        size_max: Largest lengths; sampling draws one factor for all three. None: one size.
        symmetry_deg: Angle above 0, up to 360, by which it can be turned without a visible change; 360: none.
        profile: Outline that counts for "same profile".
        aliases: Other names for paraphrased instructions.
        collision: Convex parts, as `user_mesh.read_mesh` describes; None: the convex hull, without hollows.
        double_sided: Draw both sides of a mesh that is not closed.
        mass_kg: Mass.
        friction: Coulomb friction against the table.

    Returns:
        The catalogue record.

    Raises:
        AssetError: A name is taken or no plain name, the mesh is unfit, or a number is out of bounds.
        ShapeError: Arrays have a wrong shape or dtype.
    """
    what = f"object {echo(repr(name))}"
    _check_name(name, what, "object")
    if isinstance(aliases, str):
        raise AssetError(f"aliases of {what} are {echo(repr(aliases))}; give a list of names.")
    for alias in aliases:
        _check_name(alias, f"alias {echo(repr(alias))} of {what}", "object", alias=True)
    _check_number("symmetry_deg", symmetry_deg, 0.0, 360.0, what)
    _check_number("mass_kg", mass_kg, *_MASS_KG, what)
    _check_number("friction", friction, *_FRICTION, what)
    if profile not in (None, "square", "circle"):
        raise AssetError(f"profile of {what} is {profile!r:.80}; allowed are None, 'square' and 'circle'.")
    user_mesh = read_mesh(mesh, collision, double_sided=double_sided, what=what)
    smallest = check_lengths(user_mesh.extents if size is None else size, what)
    largest = smallest if size_max is None else check_lengths(size_max, what)
    if any(most < least for least, most in zip(smallest, largest, strict=True)):
        raise AssetError(f"size_max of {what} is {largest}; no side may be shorter than in size, {smallest}.")
    spec = ObjectSpec(
        name=name,
        kind="registered",
        size_min=smallest,
        size_max=largest,
        symmetry_rad=math.radians(symmetry_deg) if symmetry_deg < 360 else 2 * math.pi,
        profile=profile,
        mass_kg=float(mass_kg),
        friction=float(friction),
        aliases=tuple(aliases),
    )
    arrays = (user_mesh.visual.vertices, user_mesh.visual.normals, user_mesh.visual.uvs, *user_mesh.parts)
    _keep("object", name, _digest(repr(spec), *arrays), user_mesh)
    REGISTERED_OBJECTS[name] = spec
    return spec


def register_texture(name: str, image: np.ndarray | str | Path) -> TextureSpec:
    """Register a texture of your own. Registering an equal one again changes nothing.

    Args:
        name: Its name in prompts, scenes and pools, such as "newspaper".
        image: Shape (H, W, 3), uint8, row 0 on top, sides of 1 to 1024 pixels; or a PNG file.

    Returns:
        The catalogue record.

    Raises:
        AssetError: A name is taken or no plain name, or the file is no opaque PNG or too large.
        ShapeError: The array has a wrong shape or dtype.
    """
    what = f"texture {echo(repr(name))}"
    _check_name(name, what, "texture")
    pixels = _read_png(as_path(image), what) if isinstance(image, str | Path) else np.asarray(image)
    if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8:
        raise ShapeError(f"{what} is {pixels.dtype} of shape {pixels.shape}; it must be uint8 of (H, W, 3).")
    if not all(1 <= side <= MAX_TEXTURE_SIDE for side in pixels.shape[:2]):
        height, width = pixels.shape[:2]
        raise AssetError(
            f"{what} has {width} × {height} pixels; sides must lie within 1 … {MAX_TEXTURE_SIDE}."
        )
    pixels = np.array(pixels, order="C")
    pixels.setflags(write=False)
    spec = TextureSpec(name, "registered")
    _keep("texture", name, _digest(repr((spec, pixels.shape)), pixels), pixels)
    REGISTERED_TEXTURES[name] = spec
    return spec


def registered_geometry(object_name: str, size: Vector3, scale: Vector3) -> Geometry:
    """Return the shape of a registered object, with sides of some lengths in metres times `scale`.

    Raises:
        AssetError: A length is out of bounds.
    """
    return _geometry(_CONTENTS["object", object_name][1], object_name, product(size, scale))


def registered_texture(texture_name: str) -> np.ndarray:
    """Return the image of a registered texture, shape (H, W, 3), uint8."""
    return _CONTENTS["texture", texture_name][1]


@lru_cache(maxsize=256)
def _geometry(mesh: UserMesh, object_name: str, lengths: Vector3) -> Geometry:
    return protect(mesh.geometry(check_lengths(lengths, f"object {object_name!r}")))


def _check_name(name: str, what: str, kind: str, *, alias: bool = False) -> None:
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise AssetError(f"{what}: a name consists of letters, digits, '-' and single spaces.")
    if name.casefold().startswith(("random ", "dark random ")):  # see `random_pack`
        raise AssetError(f"{what}: names that begin with 'random' are reserved; choose another name.")
    known = OBJECTS if kind == "object" else {**TEXTURES, NEUTRAL_TEXTURE: None}
    registered = REGISTERED_OBJECTS if kind == "object" else REGISTERED_TEXTURES
    taken = {_fold(other): other for other in (*known, *(n for n in registered if alias or n != name))}
    if (other := taken.get(_fold(name))) is not None:
        raise AssetError(f"{what}: there is {kind} {other or name!r} already; choose another name.")


def _fold(name: str) -> str:
    """A form in which names differ that readers, prompts and files tell apart."""
    return name.casefold().replace("-", " ")


def _check_number(field: str, value: float, least: float, most: float, what: str) -> None:
    if not least <= value <= most or value == 0:  # NaN fails too
        bounds = f"above {least:g}, up to {most:g}" if least == 0 else f"within {least:g} … {most:g}"
        raise AssetError(f"{field} of {what} is {float(value):g}; it must be {bounds}.")


def _keep(kind: str, name: str, digest: str, content: object) -> None:
    """Keep what an object or a texture is made of, unless an equal one is there."""
    if _CONTENTS.setdefault((kind, name), (digest, content))[0] != digest:
        raise AssetError(f"{kind} {name!r} is registered already, and differs; choose another name.")


def _digest(text: str, *arrays: np.ndarray) -> str:
    digest = hashlib.sha256(text.encode())
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _read_png(file: Path, what: str) -> np.ndarray:
    """Decode a PNG file of limited size, shape (H, W, 3), uint8."""
    try:
        pixels = np.asarray(read_png(file, max_bytes=MAX_PNG_BYTES, max_side=MAX_TEXTURE_SIDE))
    except InputFileError as error:
        raise AssetError(f"{what}: {error}") from None
    if (pixels[..., 3] != 255).any():
        raise AssetError(f"{what}: {file} is partly transparent; save it without an alpha channel.")
    return pixels[..., :3]
