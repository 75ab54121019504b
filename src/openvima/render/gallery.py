"""Asset gallery: a page with pictures of every object and texture of a pack."""

from pathlib import Path

import numpy as np

from openvima.atomic_io import atomic_write_file
from openvima.catalog import NEUTRAL_TEXTURE, OBJECTS, TEXTURES, Assets, object_spec
from openvima.catalog.objects import REGISTERED_OBJECTS
from openvima.catalog.textures import REGISTERED_TEXTURES
from openvima.errors import AssetError
from openvima.html import render_page, require_extra, thumbnail_uri
from openvima.render.camera import VIEWS
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Placement, Pose, Scene

_SAMPLE_OBJECT = "round"  # shows each texture on a large flat face and a curved wall
_SAMPLE_TEXTURE = "tiger"
_ENLARGE, _HEIGHT = 6, 144  # of what is rendered, and pixels of a picture
_OBJECT_ID = 5


def write_gallery(out: Path, assets: Assets) -> tuple[Path, tuple[str, ...]]:
    """Write index.html; the page loads nothing.

    Args:
        out: Folder; an earlier gallery there is overwritten.
        assets: The asset pack.

    Returns:
        The page, and a sentence for each object and texture that the pack lacks.
    """
    require_extra()
    rasteriser, problems = Rasteriser(assets), dict[str, None]()
    objects = [(name, name, _SAMPLE_TEXTURE) for name in (*OBJECTS, *REGISTERED_OBJECTS)]
    textures = [(n, _SAMPLE_OBJECT, n) for n in (*TEXTURES, NEUTRAL_TEXTURE, *REGISTERED_TEXTURES)]
    cards = []
    for name, object_name, texture_name in (*objects, *textures):
        try:
            cards.append((name, *_pictures(rasteriser, object_name, texture_name)))
        except AssetError as error:
            problems[str(error)] = None
            cards.append((name, f"{name} is missing", []))
    page = render_page(
        "assets", pack=assets.name, objects=cards[: len(objects)], textures=cards[len(objects) :]
    )
    return atomic_write_file(out / "index.html", page), tuple(problems)


def _pictures(rasteriser: Rasteriser, object_name: str, texture_name: str) -> tuple[str, list[str]]:
    """Return the extents of an object on the table, and its pictures from the front and from above."""
    size = object_spec(object_name).size_max
    geometry = rasteriser.assets.geometry(object_name, size)
    pose = Pose.planar(0.5, 0.0, np.pi / 2, z=geometry.rest_z_m)
    scene = Scene((Placement(_OBJECT_ID, object_name, texture_name, size, pose),))
    images = rasteriser.scene(scene, enlarge=_ENLARGE)
    lengths = np.ptp(geometry.visual.vertices.reshape(-1, 3), axis=0)
    return (
        " × ".join(f"{100 * length:.1f}" for length in lengths) + " cm",
        [thumbnail_uri(images[view].rgb, images[view].segm == _OBJECT_ID, _HEIGHT) for view in VIEWS],
    )
