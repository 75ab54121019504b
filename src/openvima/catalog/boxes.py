"""Boxes, and bodies made of boxes: blocks, line, container, square and three-sided rectangle.

Source: the body descriptions of VIMA-Bench, whose textures fold onto a box as a 4 × 4 atlas.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from openvima.catalog.geometry import CollisionBox, Geometry, TriangleMesh, Vector3

SHEET_THICKNESS_M = 0.001  # of flat marks on the table, whatever their nominal height
WALL_M = 0.002
HEIGHT_DIVISOR = 1.1  # nominal over true height of the container in VIMA-Bench
FLOOR_Z_M = -0.001  # height of the surface on which bodies rest


@dataclass(frozen=True, slots=True)
class Box:
    """A box along the axes of the link frame.

    Args:
        size: Full extents in metres.
        centre: Centre in metres.
    """

    size: Vector3
    centre: Vector3 = (0.0, 0.0, 0.0)

    def to_collision(self) -> CollisionBox:
        """Return the box as a collision shape."""
        x, y, z = self.size
        return CollisionBox((x / 2, y / 2, z / 2), self.centre)


def _unit_faces() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners, normals and texture coordinates of the cube with edges −1 … 1, two triangles a face."""
    quads = {
        (0, 0, 1): ((-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)),
        (0, 0, -1): ((-1, 1, -1), (1, 1, -1), (1, -1, -1), (-1, -1, -1)),
        (-1, 0, 0): ((-1, 1, -1), (-1, -1, -1), (-1, -1, 1), (-1, 1, 1)),
        (1, 0, 0): ((1, -1, -1), (1, 1, -1), (1, 1, 1), (1, -1, 1)),
        (0, -1, 0): ((-1, -1, -1), (1, -1, -1), (1, -1, 1), (-1, -1, 1)),
        (0, 1, 0): ((1, 1, -1), (-1, 1, -1), (-1, 1, 1), (1, 1, 1)),
    }
    corners, normals, uvs = [], [], []
    for normal, quad in quads.items():
        for triangle in ((0, 1, 2), (0, 2, 3)):
            corners.append([quad[i] for i in triangle])
            normals.append([normal] * 3)
            uvs.append([_atlas_uv(normal, quad[i]) for i in triangle])
    return np.array(corners, dtype=np.float64), np.array(normals, dtype=np.float64), np.array(uvs)


def _atlas_uv(normal: tuple[int, int, int], corner: tuple[int, int, int]) -> tuple[float, float]:
    """Texture coordinates of one corner of the unit cube: every face gets a sixteenth of the image."""
    a, b, c = ((coordinate + 1) / 2 for coordinate in corner)
    return {
        (0, 0, 1): (0.75 + a / 4, 0.25 - b / 4),
        (0, 0, -1): (0.5 - a / 4, 0.25 - b / 4),
        (-1, 0, 0): (0.5 + b / 4, c / 4),
        (1, 0, 0): (0.25 - c / 4, 0.5 - b / 4),
        (0, -1, 0): (0.25 + a / 4, 0.25 + (1 - c) / 4),
        (0, 1, 0): (a / 4, c / 4),
    }[normal]


_CORNERS, _NORMALS, _UVS = _unit_faces()


def box_mesh(boxes: Sequence[Box]) -> TriangleMesh:
    """Return the triangles of several boxes, each wrapped in the whole texture, in the given order."""
    vertices = [_CORNERS * (np.array(box.size) / 2) + np.array(box.centre) for box in boxes]
    return TriangleMesh(
        np.concatenate(vertices), np.tile(_NORMALS, (len(boxes), 1, 1)), np.tile(_UVS, (len(boxes), 1, 1))
    )


def block(size: Vector3) -> Geometry:
    """Return a solid box, origin at its centre."""
    box = Box(size)
    return Geometry(box_mesh([box]), (box.to_collision(),), size[2] / 2 + FLOOR_Z_M)


def line(size: Vector3) -> Geometry:
    """Return a strip on the table without collision; its thickness is fixed."""
    strip = Box((size[0], size[1], SHEET_THICKNESS_M))
    return Geometry(box_mesh([strip]), (), SHEET_THICKNESS_M / 2)


def container(size: Vector3) -> Geometry:
    """Return an open box, origin at its centre; the middle planes of its walls are on the borders."""
    x, y, height = size[0], size[1], size[2] / HEIGHT_DIVISOR
    boxes = [
        Box((x, y, WALL_M), (0.0, 0.0, -height / 2)),
        Box((x, WALL_M, height), (0.0, -y / 2, 0.0)),
        Box((x, WALL_M, height), (0.0, y / 2, 0.0)),
        Box((WALL_M, y, height), (-x / 2, 0.0, 0.0)),
        Box((WALL_M, y, height), (x / 2, 0.0, 0.0)),
    ]
    rest_z_m = (height + WALL_M) / 2 + FLOOR_Z_M
    return Geometry(box_mesh(boxes), tuple(box.to_collision() for box in boxes), rest_z_m)


def square(size: Vector3) -> Geometry:
    """Return four flat bars, `size[0]` long and `size[1]` wide, around an opening.

    Its collision shape is a single strip through the middle, as in VIMA-Bench.
    """
    length, width, half = size[0], size[1], size[0] / 2
    boxes = [
        Box((length, width, SHEET_THICKNESS_M), (0.0, half, 0.0)),
        Box((length, width, SHEET_THICKNESS_M), (0.0, -half, 0.0)),
        Box((width, length, SHEET_THICKNESS_M), (half, 0.0, 0.0)),
        Box((width, length, SHEET_THICKNESS_M), (-half, 0.0, 0.0)),
    ]
    strip = CollisionBox((length / 2, width / 2, SHEET_THICKNESS_M))
    return Geometry(box_mesh(boxes), (strip,), 0.0)


def three_sided_rectangle(size: Vector3) -> Geometry:
    """Return three flat bars, open towards +y: `size[0]` is the extent along y, `size[1]` the one along x."""
    depth, width, bar = size[0], size[1], 0.04
    boxes = [
        Box((width, bar, SHEET_THICKNESS_M), (0.0, -depth / 2, 0.0)),
        Box((bar, depth, SHEET_THICKNESS_M), (width / 2, 0.0, 0.0)),
        Box((bar, depth, SHEET_THICKNESS_M), (-width / 2, 0.0, 0.0)),
    ]
    return Geometry(box_mesh(boxes), (), 0.0)
