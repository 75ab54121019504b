"""Asset gallery: a page with thumbnails, dimensions and users of every object and texture of a pack."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from openvima.atomic_io import atomic_write_file
from openvima.catalog import (
    LEVELS,
    NEUTRAL_TEXTURE,
    OBJECT_SETS,
    OBJECTS,
    TEXTURE_SETS,
    TEXTURES,
    Assets,
    ObjectSpec,
    TextureSpec,
    object_spec,
    pool,
    tasks_at,
    texture_spec,
)
from openvima.catalog.geometry import TriangleMesh
from openvima.catalog.objects import REGISTERED_OBJECTS
from openvima.catalog.textures import REGISTERED_TEXTURES
from openvima.errors import AssetError
from openvima.html import render_page, require_extra
from openvima.multiprocess import Report
from openvima.render import channels_last
from openvima.render.camera import VIEWS, View
from openvima.render.rasteriser import Drawable, Rasteriser
from openvima.scene import Pose, Scene

Detail = Literal[1, 2]

_OBJECT_ID = 9
_WIDTH_M, _HEIGHT_M = 0.64, 0.48  # of the window of a thumbnail
_PX_PER_M = 250  # of both views at benchmark resolution, slightly less than theirs
_FILLED_FRACTION = 0.94
_SAMPLES = 2  # per pixel and axis, for anti-aliasing
_LONG = 2  # aspect ratio from which an object is drawn horizontally


def draw_thumbnail(
    rasteriser: Rasteriser, object_name: str, texture_name: str, view: View, *, detail: Detail = 1
) -> np.ndarray:
    """Draw an object of the catalogue so that it fills the image.

    The pose is that of prompt images, so that letters are upright; long objects are horizontal.

    Args:
        rasteriser: Rasteriser with the asset pack.
        object_name: Display name.
        texture_name: Display name.
        view: "front" looks down at 45 degrees, "top" from above.
        detail: 1 for 240 × 320 pixels, 2 for 480 × 640.

    Returns:
        Red, green, blue and opacity, shape (240 · detail, 320 · detail, 4), uint8, row 0 on top.

    Raises:
        UnknownNameError, UnknownNameError, AssetError: The pack has no such shape or texture.
    """
    mesh = rasteriser.assets.geometry(object_name, object_spec(object_name).size_max).visual
    texture = rasteriser.assets.texture(texture_name)
    low, high = (bound(mesh.vertices, axis=(0, 1)) for bound in (np.min, np.max))
    length_x, length_y, length_z = (high - low).tolist()
    is_across = length_y > _LONG * length_x
    across, along = (length_y, length_x) if is_across else (length_x, length_y)
    upwards = along if view == "top" else (along + length_z) / np.sqrt(2)
    factor = _FILLED_FRACTION * min(_WIDTH_M / across, _HEIGHT_M / upwards)
    foot = np.array([*(low + high)[:2] / 2, low[2]])
    magnified = TriangleMesh((mesh.vertices - foot) * factor, mesh.normals, mesh.uvs)
    pose = Pose.planar(0.5, 0.0, 0.0 if is_across else np.pi / 2)
    body = Drawable(magnified, pose, _OBJECT_ID, texture)
    enlarge = 2 * detail * _SAMPLES
    rendered = rasteriser.scene(Scene(()), views=(view,), extra=(body,), enlarge=enlarge)[view]
    opaque = rendered.segm == _OBJECT_ID
    return _antialias(_crop(channels_last(rendered.rgb), opaque, enlarge), _SAMPLES)


def _crop(rgb: np.ndarray, opaque: np.ndarray, enlarge: int) -> np.ndarray:
    """Crop the window around the object, shape (H, W, 4), uint8."""
    height, width = (round(length * _PX_PER_M * enlarge) for length in (_HEIGHT_M, _WIDTH_M))
    rows, columns = np.flatnonzero(opaque.any(axis=1)), np.flatnonzero(opaque.any(axis=0))
    top = (rows[0] + rows[-1] + 1 - height) // 2
    left = (columns[0] + columns[-1] + 1 - width) // 2
    image = np.concatenate([rgb, np.where(opaque, 255, 0)[..., None].astype(np.uint8)], axis=2)
    image = np.pad(image, ((height, height), (width, width), (0, 0)))
    return image[top + height : top + 2 * height, left + width : left + 2 * width]


def _antialias(image: np.ndarray, samples: int) -> np.ndarray:
    """Average squares of pixels; transparent ones give no colour."""
    height, width = image.shape[0] // samples, image.shape[1] // samples
    squares = image.reshape(height, samples, width, samples, 4)
    sums = np.zeros((height, width, 4))
    for row, column in np.ndindex(samples, samples):
        sample = squares[:, row, :, column].astype(np.float64)
        sums[..., :3] += sample[..., :3] * sample[..., 3:]
        sums[..., 3:] += sample[..., 3:]
    colour = sums[..., :3] / np.maximum(sums[..., 3:], 1)
    return np.rint(np.concatenate([colour, sums[..., 3:] / samples**2], axis=2)).astype(np.uint8)


Card = dict[str, object]  # values of the template's macro `card`

PICTURES = "pictures"
_SWATCH_PX = 240
_SAMPLE_OBJECT = "round"  # shows each texture on a large flat face and a curved wall
_HEROES = ("wooden", "yellow", "cyan", "tiger", "blue and purple stripe", "orange", "brick", "pink")
_KINDS = {
    "kit": "flat prism",
    "box": "box of the sampled size",
    "compound": "put together from boxes",
    "mesh": "modelled shape of one size",
    "registered": "registered mesh",
}
_CATEGORIES = {
    "plain": "Plain colours",
    "special": "Materials and single patterns",
    "stripe": "Stripes",
    "polka_dot_2": "Polka dots in two colours",
    "swirl": "Swirls",
    "paisley": "Paisleys",
    "neutral": "Neutral",
    "registered": "Registered",
}


def write_gallery(out: Path, assets: Assets, *, report: Report | None = None) -> tuple[Path, tuple[str, ...]]:
    """Write index.html and its images; the page loads nothing from the network.

    Args:
        out: Folder; an earlier gallery there is overwritten.
        assets: The asset pack.
        report: Called with entries rendered, entries in all, and the last one's name.

    Returns:
        The page, and a sentence for each object and texture that the pack lacks.
    """
    require_extra()
    artist = _Artist(out, Rasteriser(assets))
    specs = [*TEXTURES.values(), texture_spec(NEUTRAL_TEXTURE), *REGISTERED_TEXTURES.values()]
    object_specs = [*OBJECTS.values(), *REGISTERED_OBJECTS.values()]
    total = len(object_specs) + len(specs)
    objects = []
    for index, spec in enumerate(object_specs):
        objects.append(_object_card(artist, spec, index))
        if report:
            report(len(objects), total, spec.name)
    textures: dict[str, list[Card]] = {title: [] for title in _CATEGORIES.values()}
    for index, spec in enumerate(specs, len(objects) + 1):
        textures[_CATEGORIES[spec.category]].append(_texture_card(artist, spec))
        if report:
            report(index, total, spec.name)
    page = render_page(
        "assets",
        pack=assets.name,
        levels=LEVELS,
        objects=objects,
        textures={title: cards for title, cards in textures.items() if cards},
        num_textures=len(specs) - 1,  # without the neutral one
    )
    return atomic_write_file(out / "index.html", page), tuple(dict.fromkeys(artist.problems))


class _Artist:
    """Renders images into the page's folder."""

    def __init__(self, out: Path, rasteriser: Rasteriser) -> None:
        self.out = out
        self.rasteriser = rasteriser
        self.problems: list[str] = []

    def thumbnail(self, object_name: str, texture_name: str, view: View, *, detail: Detail = 1) -> Card:
        return self._picture(
            _slug(f"{object_name} in {texture_name} {view}"),
            f"{texture_name} {object_name}" + (", from above" if view == "top" else ""),
            lambda: draw_thumbnail(self.rasteriser, object_name, texture_name, view, detail=detail),
        )

    def swatch(self, texture_name: str) -> Card:
        return self._picture(
            _slug(f"texture {texture_name}"),
            f"texture {texture_name}",
            lambda: _shrunk(self.rasteriser.assets.texture(texture_name)),
        )

    def _picture(self, name: str, title: str, draw: Callable[[], np.ndarray]) -> Card:
        try:
            pixels = draw()
        except AssetError as error:
            self.problems.append(str(error))
            return {"title": title, "file": None}
        stream = io.BytesIO()
        Image.fromarray(pixels).save(stream, "PNG")
        atomic_write_file(self.out / PICTURES / f"{name}.png", stream.getvalue())
        height, width = pixels.shape[:2]
        return {"title": title, "file": f"{PICTURES}/{name}.png", "width": width, "height": height}


def _object_card(artist: _Artist, spec: ObjectSpec, index: int) -> Card:
    hero = _HEROES[index % len(_HEROES)]
    views = [artist.thumbnail(spec.name, hero, view, detail=2) for view in VIEWS]
    facts = {
        "size": _extent(artist, spec),
        "mass": f"{1000 * spec.mass_kg:g} g",
        "turned": _symmetry(spec.symmetry_rad),
        "sets": _sets_with(spec.name, OBJECT_SETS),
    }
    rows = {
        "moved": _levels_where(lambda pool: spec.name in pool.dragged_objects),
        "base": _levels_where(lambda pool: spec.name in pool.base_objects),
    }
    return {
        "id": _slug(spec.name),
        "name": spec.name,
        "kind": _KINDS[spec.kind],
        "views": views,
        "facts": facts,
        "roles": rows,
    }


def _texture_card(artist: _Artist, spec: TextureSpec) -> Card:
    facts = {}
    try:
        image = artist.rasteriser.assets.texture(spec.name)
    except AssetError:
        facts["image"] = "missing"
    else:
        height, width = image.shape[:2]
        mean = image.reshape(-1, 3).mean(axis=0)
        facts["mean" if width > 1 else "RGB"] = ", ".join(f"{channel:.0f}" for channel in mean)
        if width > 1:
            facts["image"] = f"{width} × {height} pixels"
    facts["sets"] = _sets_with(spec.name, TEXTURE_SETS)
    rows = {
        "moved": _levels_where(lambda pool: spec.name in pool.dragged_textures),
        "base": _levels_where(lambda pool: spec.name in pool.base_textures),
    }
    return {
        "id": _slug(f"texture {spec.name}"),
        "name": spec.name,
        "kind": "",
        "views": [artist.swatch(spec.name), artist.thumbnail(_SAMPLE_OBJECT, spec.name, "front")],
        "facts": facts,
        "roles": rows,
    }


def _extent(artist: _Artist, spec: ObjectSpec) -> str:
    """Measures of what is drawn; for objects of several sizes the largest, and the range of the sides."""
    try:
        vertices = artist.rasteriser.assets.geometry(spec.name, spec.size_max).visual.vertices
    except AssetError:
        return "unknown"
    lengths = np.ptp(vertices.reshape(-1, 3), axis=0)
    text = " × ".join(f"{100 * length:.1f}" for length in lengths) + " cm"
    if spec.kind in ("box", "compound", "registered") and spec.size_min != spec.size_max:
        text += f", sides from {100 * spec.size_min[0]:.0f} to {100 * spec.size_max[0]:.0f}"
    return text


def _symmetry(symmetry_rad: float | None) -> str:
    if symmetry_rad is None:
        return "not stated"
    if symmetry_rad == 0:
        return "same at any angle"
    degrees = round(np.rad2deg(symmetry_rad))
    return "no symmetry" if degrees == 360 else f"counts as the same every {degrees}°"


def _sets_with(name: str, sets: dict[str, tuple[str, ...]]) -> str:
    return ", ".join(title for title, members in sets.items() if name in members) or "none"


def _levels_where(is_used: Callable[..., bool]) -> dict[str, tuple[str, ...]]:
    """Levels with the tasks of which the pool passes, for those levels that have any."""
    found = {level: tuple(t for t in tasks_at(level) if is_used(pool(t, level))) for level in LEVELS}
    return {level: tasks for level, tasks in found.items() if tasks}


def _shrunk(image: np.ndarray) -> np.ndarray:
    """A picture of a texture no larger than the page shows it; a plain colour becomes an area."""
    height, width = image.shape[:2]
    if width == 1:
        return np.broadcast_to(image, (_SWATCH_PX, _SWATCH_PX, 3)).copy()
    factor = min(1.0, _SWATCH_PX / min(height, width))
    size = (round(width * factor), round(height * factor))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS))


def _slug(text: str) -> str:
    return text.lower().replace(" ", "-")
