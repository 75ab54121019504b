"""Geometry of each object: visual mesh, collision shapes and rest height.

Boxes come in any size and are made here, shapes of one size are read from `shapes.npz`. Dimensions are those
of VIMA-Bench, whose textures fold onto a box as a 4 × 4 atlas. Two poses differ: the bowl is centred on its
origin, and the letter T is upright.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from openvima.catalog.geometry import CollisionBox, CollisionHull, Geometry, TriangleMesh, Vector3, product
from openvima.catalog.meshes import combine, drape, scale_geometry
from openvima.catalog.objects import object_spec

SHEET_THICKNESS_M = 0.001  # of flat marks on the table, whatever their nominal height
WALL_M = 0.002
HEIGHT_DIVISOR = 1.1  # nominal over true height of the container in VIMA-Bench
FLOOR_Z_M = -0.001  # height of the surface on which bodies rest


def box(size: Vector3, centre: Vector3 = (0.0, 0.0, 0.0)) -> CollisionBox:
    """Return a box of some full extents, metres."""
    x, y, z = size
    return CollisionBox((x / 2, y / 2, z / 2), centre)


def box_mesh(boxes: Sequence[CollisionBox]) -> TriangleMesh:
    """Return the triangles of several boxes, each wrapped in the whole texture, in the given order."""
    cube = fixed_geometry("cube").visual  # with edges −1 … 1; every face gets a sixteenth of the texture
    return combine(
        [TriangleMesh(cube.vertices * box.half_size + box.centre, cube.normals, cube.uvs) for box in boxes]
    )


def block(size: Vector3) -> Geometry:
    """Return a solid box, origin at its centre."""
    return Geometry(box_mesh([box(size)]), (box(size),), size[2] / 2 + FLOOR_Z_M)


def line(size: Vector3) -> Geometry:
    """Return a strip on the table without collision; its thickness is fixed."""
    strip = box((size[0], size[1], SHEET_THICKNESS_M))
    return Geometry(box_mesh([strip]), rest_z_m=SHEET_THICKNESS_M / 2)


def container(size: Vector3) -> Geometry:
    """Return an open box, origin at its centre; the middle planes of its walls are on the borders."""
    x, y, height = size[0], size[1], size[2] / HEIGHT_DIVISOR
    boxes = [
        box((x, y, WALL_M), (0.0, 0.0, -height / 2)),
        *(box((x, WALL_M, height), (0.0, at, 0.0)) for at in (-y / 2, y / 2)),
        *(box((WALL_M, y, height), (at, 0.0, 0.0)) for at in (-x / 2, x / 2)),
    ]
    rest_z_m = (height + WALL_M) / 2 + FLOOR_Z_M
    return Geometry(box_mesh(boxes), tuple(boxes), rest_z_m)


def square(size: Vector3) -> Geometry:
    """Return four flat bars, `size[0]` long and `size[1]` wide, around an opening.

    Its collision shape is a single strip through the middle, as in VIMA-Bench.
    """
    length, width, half = size[0], size[1], size[0] / 2
    boxes = [
        *(box((length, width, SHEET_THICKNESS_M), (0.0, at, 0.0)) for at in (half, -half)),
        *(box((width, length, SHEET_THICKNESS_M), (at, 0.0, 0.0)) for at in (half, -half)),
    ]
    strip = CollisionBox((length / 2, width / 2, SHEET_THICKNESS_M))
    return Geometry(box_mesh(boxes), (strip,))


def three_sided_rectangle(size: Vector3) -> Geometry:
    """Return three flat bars, open towards +y: `size[0]` is the extent along y, `size[1]` the one along x."""
    depth, width, bar = size[0], size[1], 0.04
    boxes = [
        box((width, bar, SHEET_THICKNESS_M), (0.0, -depth / 2, 0.0)),
        *(box((bar, depth, SHEET_THICKNESS_M), (at, 0.0, 0.0)) for at in (width / 2, -width / 2)),
    ]
    return Geometry(box_mesh(boxes))


def build_geometry(object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
    """Build the shape of a catalogue object.

    Args:
        object_name: Display name.
        size: Sampled nominal size in metres; kit objects, bowl, pan, pallet, frame, stand and disk have one
            size and ignore it.
        scale: Factor per axis on top of it.

    Raises:
        UnknownNameError: The catalogue has no such object.
    """
    if object_name not in BOX_SHAPES:
        return scale_geometry(fixed_geometry(object_spec(object_name).name), scale)
    geometry = BOX_SHAPES[object_name](product(size, scale))
    return replace(geometry, visual=drape(geometry.visual))


@cache
def fixed_geometry(name: str) -> Geometry:
    """Load a shape of one size from `shapes.npz`; "stand with long rods" is that of the original pack.

    Of each shape the file has `visual`, (F, 3, 8): position, normal and texture coordinates of each corner;
    `hulls`, (N, 3): points of all convex parts; `ends`: where each part ends among them; and `rest_z_m`.
    """
    with np.load(Path(__file__).with_name("shapes.npz")) as file:
        visual, hulls, ends, rest_z_m = (
            file[f"{name}/{part}"] for part in ("visual", "hulls", "ends", "rest_z_m")
        )
    mesh = TriangleMesh(*(np.ascontiguousarray(part) for part in np.split(visual, (3, 6), axis=2)))
    return Geometry(mesh, tuple(map(CollisionHull, np.split(hulls, ends[:-1]))), float(rest_z_m))


BOX_SHAPES: dict[str, Callable[[Vector3], Geometry]] = {
    "block": block,
    "shorter block": block,
    "small block": block,
    "line": line,
    "three-sided rectangle": three_sided_rectangle,
    "square": square,
    "container": container,
}
"""Builders from size times scale."""
