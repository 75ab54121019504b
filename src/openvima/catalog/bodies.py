"""Procedural geometry of each object: visual mesh, collision shapes and rest height.

Dimensions are those of VIMA-Bench, whose textures fold onto a box as a 4 × 4 atlas. Two poses differ: the
bowl is centred on its origin, and the letter T is upright.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from openvima.catalog.geometry import (
    CollisionBox,
    CollisionHull,
    CollisionShape,
    Geometry,
    TriangleMesh,
    Vector3,
)
from openvima.catalog.meshes import combine, drape, prism, revolve, scale_geometry, sheared_up, slab_hull
from openvima.catalog.objects import ObjectSpec, object_spec
from openvima.catalog.outlines import arc, outline, rectangle, regular_polygon, signed_area
from openvima.errors import AssetError

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


_BOWL_SIDES = 26
_BOWL_WALL_PARTS = 13  # with the floor 14 convex parts
_BOWL_FLOOR_Z = 0.009
_BOWL_RIM_Z = 0.0692
_BOWL_BOTTOM = ((0.0, 0.0002), (0.0797, 0.0002))
_BOWL_WALL = (
    (0.0797, 0.0002),
    (0.0872, 0.0300),
    (0.0925, 0.0570),
    (0.0995, 0.0640),
    (0.0998, 0.0685),
    (0.0965, _BOWL_RIM_Z),
    (0.0915, 0.0670),
    (0.0860, 0.0550),
    (0.0790, 0.0280),
    (0.0690, 0.0115),
    (0.0560, _BOWL_FLOOR_Z),
    (0.0, _BOWL_FLOOR_Z),
)
_BOWL_TEXTURE_PER_M = 2.9  # the outer wall reaches the edge of the image

_PAN_SIDES = 30
_PAN_BOTTOM = ((0.0, -0.0138), (0.0650, -0.0138))
_PAN_DISH = (
    (0.0650, -0.0138),
    (0.0765, -0.0055),
    (0.0835, 0.0125),
    (0.0845, 0.0140),
    (0.0815, 0.0135),
    (0.0745, -0.0035),
    (0.0640, -0.0112),
    (0.0590, -0.0112),
    (0.0, -0.0112),
)
_PAN_HANDLE_LOW = (0.0780, 0.0065)  # x, and height of its upper face there
_PAN_HANDLE_HIGH = (0.2082, 0.0275)
_PAN_HANDLE_THICKNESS = 0.0055
_PAN_TEXTURE_PER_M = 2.3  # the tip of the handle is just inside the image


def bowl_mesh() -> TriangleMesh:
    """Return the mesh of the bowl; its axis is the z axis (beside it in the original pack)."""
    outside = [_rim_distance(radius, z) for radius, z in _BOWL_WALL[:5]]
    inside = [radius for radius, _ in _BOWL_WALL[5:]]
    wall_radii = [_BOWL_TEXTURE_PER_M * distance for distance in (*outside, *inside)]
    bottom_radii = [_BOWL_TEXTURE_PER_M * radius for radius, _ in _BOWL_BOTTOM]
    return combine(
        [
            revolve(_BOWL_BOTTOM, _BOWL_SIDES, texture_radii=bottom_radii),
            revolve(_BOWL_WALL, _BOWL_SIDES, texture_radii=wall_radii),
        ]
    )


def _rim_distance(radius: float, z: float) -> float:
    """Distance from the bowl's axis to a point of its outer wall along a cloth draped over it, in metres."""
    return radius + 0.7 * (_BOWL_RIM_Z - z)


def bowl_collision() -> tuple[CollisionShape, ...]:
    """Return a floor disc and a ring of wall parts, each convex."""
    angles = 2 * math.pi * np.arange(_BOWL_WALL_PARTS + 1) / _BOWL_WALL_PARTS
    around = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 9)
    # Chords of the inner circle cut corners: stretch the inner radius so that the flat faces touch it.
    reach = 1 / math.cos(math.pi / _BOWL_WALL_PARTS)
    low, high = 0.0, _BOWL_RIM_Z
    floor_heights = (low, _BOWL_FLOOR_Z - 0.001)  # hulls touch 1 mm away
    floor = [(0.074 * x, 0.074 * y, z) for x, y in around[:-1] for z in floor_heights]
    section = (
        (0.0797, low),
        (0.0690 * reach, low),
        (0.0690 * reach, 0.0115),
        (0.0905 * reach, high),
        (0.1000, high),
    )
    walls = [
        [(r * x, r * y, z) for x, y in around[i : i + 2] for r, z in section] for i in range(_BOWL_WALL_PARTS)
    ]
    return tuple(CollisionHull(np.array(part)) for part in (floor, *walls))


def pan_mesh() -> TriangleMesh:
    """Return the mesh of the pan: a dish about the z axis and a handle along +x with a hole at its end."""
    dish_radii = [_PAN_TEXTURE_PER_M * radius for radius, _ in _PAN_DISH]
    bottom_radii = [_PAN_TEXTURE_PER_M * radius for radius, _ in _PAN_BOTTOM]
    (x_low, z_low), (x_high, z_high) = _PAN_HANDLE_LOW, _PAN_HANDLE_HIGH
    plate = prism(_handle_loops(), z_low - _PAN_HANDLE_THICKNESS, z_low, texture_per_m=_PAN_TEXTURE_PER_M)
    return combine(
        [
            revolve(_PAN_BOTTOM, _PAN_SIDES, texture_radii=bottom_radii),
            revolve(_PAN_DISH, _PAN_SIDES, texture_radii=dish_radii),
            sheared_up(plate, (z_high - z_low) / (x_high - x_low), x_low),
        ]
    )


def _handle_loops() -> list[np.ndarray]:
    """Outline of the handle from above: narrow at the dish, wide and round at its end, with a hole there."""
    x_low, x_high = _PAN_HANDLE_LOW[0], _PAN_HANDLE_HIGH[0]
    half_width = 0.0135
    tip = arc((x_high - half_width, 0.0), (half_width, half_width), (-90, 90), 9)
    neck = [(x_low, -0.0110), (0.100, -0.0085), (0.140, -0.0105)]
    outer = np.round([*neck, *tip, *[(x, -y) for x, y in reversed(neck)]], 6)
    near, far = (
        arc((0.1800, 0.0), (0.0045, 0.0045), (90, 270), 5),
        arc((0.1945, 0.0), (0.0045, 0.0045), (-90, 90), 5),
    )
    hole = np.round([*near, *far], 6)
    return [outer, hole if signed_area(hole) < 0 else hole[::-1]]


_PLATE_M, _PLATE_THICKNESS_M = 0.18, 0.01
_ROD_RADIUS_M, _ROD_TOP_Z, _ROD_SIDES = 0.007, 0.105, 12
_ROD_TEXTURE_PER_M = 3.5
_DISK_RADIUS_M, _HOLE_RADIUS_M, _DISK_HALF_HEIGHT_M, _DISK_PARTS = 0.045, 0.0225, 0.015, 12
LONG_RODS_Z = -0.045
"""Lower end of the rods in the original pack, where they reach through the plates."""


def hanoi_stand(rod_low_z: float = -_PLATE_THICKNESS_M / 2) -> Geometry:
    """Return three plates in a row along y, each with a rod in its middle; origin in the middle plate.

    Args:
        rod_low_z: Where the rods begin, metres; by default at the lower faces of the plates.
    """
    half, middles = _PLATE_THICKNESS_M / 2, (-_PLATE_M, 0.0, _PLATE_M)
    plates = [Box((_PLATE_M, _PLATE_M, _PLATE_THICKNESS_M), (0.0, y, 0.0)) for y in middles]
    rod = _rod(rod_low_z, _ROD_TOP_Z)
    visual = combine([drape(box_mesh(plates)), *(_move(rod, (0.0, y, 0.0)) for y in middles)])
    plate = np.array(rectangle((0.0, 0.0), (_PLATE_M / 2, _PLATE_M / 2)))
    circle = np.array(regular_polygon(_ROD_SIDES, _ROD_RADIUS_M))
    hulls = [slab_hull(plate + np.array((0.0, y)), -half, half) for y in middles]
    hulls += [slab_hull(circle + np.array((0.0, y)), rod_low_z, _ROD_TOP_Z) for y in middles]
    return Geometry(visual, tuple(hulls), rest_z_m=-min(rod_low_z, -half))


def hanoi_disk() -> Geometry:
    """Return a flat ring, origin at its centre; what collides is open in the middle, too."""
    low, high = -_DISK_HALF_HEIGHT_M, _DISK_HALF_HEIGHT_M
    outer = np.round(regular_polygon(32, _DISK_RADIUS_M), 6)
    inner = np.round(regular_polygon(16, _HOLE_RADIUS_M), 6)
    return Geometry(prism([outer, inner[::-1]], low, high), _ring_parts(low, high), rest_z_m=high)


def _ring_parts(low: float, high: float) -> tuple[CollisionHull, ...]:
    angles = 2 * math.pi * np.arange(_DISK_PARTS + 1) / _DISK_PARTS
    around = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 9)
    sectors = (
        np.concatenate([_HOLE_RADIUS_M * around[i : i + 2], _DISK_RADIUS_M * around[i : i + 2]])
        for i in range(_DISK_PARTS)
    )
    return tuple(slab_hull(sector, low, high) for sector in sectors)


def _rod(low: float, high: float) -> TriangleMesh:
    """An upright rod about the z axis with sharp edges."""
    radius = _ROD_RADIUS_M
    sides = ((0.0, low), (radius, low)), ((radius, low), (radius, high)), ((radius, high), (0.0, high))
    distances = (0.0, radius), (radius + high - max(low, 0.0), radius), (radius, 0.0)
    return combine(
        [
            revolve(side, _ROD_SIDES, texture_radii=[_ROD_TEXTURE_PER_M * d for d in distance])
            for side, distance in zip(sides, distances, strict=True)
        ]
    )


def _move(mesh: TriangleMesh, offset: Vector3) -> TriangleMesh:
    return TriangleMesh(mesh.vertices + np.array(offset), mesh.normals, mesh.uvs)


def build_geometry(object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
    """Build the shape of a catalogue object.

    Args:
        object_name: Display name.
        size: Sampled nominal size in metres; kit objects, bowl, pan, pallet, frame, stand and disk have one
            size and ignore it.
        scale: Factor per axis on top of it.

    Raises:
        UnknownNameError: The catalogue has no such object.
        AssetError: A size or factor that the object needs is not positive.
    """
    spec = object_spec(object_name)
    if not all(factor > 0 for factor in scale):
        raise AssetError(f"scale of {object_name} is {scale}; all three factors must be above 0.")
    if spec.kind == "kit":
        return scale_geometry(_kit(spec), scale)
    if object_name in _FIXED_SIZE:
        return scale_geometry(_FIXED_SIZE[object_name](), scale)
    build, needed_lengths = BOX_SHAPES[object_name]
    product = (size[0] * scale[0], size[1] * scale[1], size[2] * scale[2])
    if not all(length > 0 for length in product[:needed_lengths]):
        raise AssetError(
            f"size of {object_name} is {product} m; its first {needed_lengths} lengths must be above 0."
        )
    geometry = build(product)
    return replace(geometry, visual=drape(geometry.visual))


def has_fixed_size(object_name: str) -> bool:
    """Whether an object's shape ignores the sampled size."""
    return object_spec(object_name).kind == "kit" or object_name in _FIXED_SIZE


@cache  # tasks scale these few shapes by new factors in each episode
def _kit(spec: ObjectSpec) -> Geometry:
    loops = outline(spec.name)
    height = spec.size_max[2] / HEIGHT_DIVISOR
    return Geometry(prism(loops, 0.0, height), (slab_hull(loops[0], 0.0, height),), 0.0)


def _frame() -> Geometry:
    loops = [np.array(rectangle((0.0, 0.0), (half, half))) for half in (0.09, 0.081)]
    thickness = 0.0015
    visual = prism([loops[0], loops[1][::-1]], 0.0, thickness)
    return Geometry(visual, (slab_hull(loops[0], 0.0, thickness),), rest_z_m=0.0)


def _pallet() -> Geometry:
    """Two decks of seven boards each along y, and three runners along x between them."""
    length, width, height = 0.21, 0.175, 0.02625
    outer, inner, gap, thickness = 0.0245, 0.0175, 0.01225, 0.0035
    parts: list[Box] = []
    left = -length / 2
    for board in (outer, *([inner] * 5), outer):
        parts += [
            Box((board, width, thickness), (left + board / 2, 0.0, side * (height - thickness) / 2))
            for side in (-1, 1)
        ]
        left += board + gap
    parts += [Box((length, 0.007, height - 2 * thickness), (0.0, y, 0.0)) for y in (-0.084, 0.0, 0.084)]
    plan = np.array(rectangle((0.0, 0.0), (length / 2, width / 2)))
    hull = slab_hull(plan, -height / 2, height / 2)
    return Geometry(drape(box_mesh(parts)), (hull,), rest_z_m=height / 2)


def _bowl() -> Geometry:
    return Geometry(bowl_mesh(), bowl_collision(), rest_z_m=0.0)


def _pan() -> Geometry:
    visual = pan_mesh()
    hull = CollisionHull(np.unique(visual.vertices.reshape(-1, 3), axis=0))
    # One hull for dish and handle: objects put into the pan rest on its lid, as in VIMA-Bench.
    return Geometry(visual, (hull,), rest_z_m=float(-visual.vertices[..., 2].min()))


_FIXED_SIZE: dict[str, Callable[[], Geometry]] = {
    "pallet": _pallet,
    "frame": _frame,
    "bowl": _bowl,
    "pan": _pan,
    "stand": hanoi_stand,
    "disk": hanoi_disk,
}
BOX_SHAPES: dict[str, tuple[Callable[[Vector3], Geometry], int]] = {
    "block": (block, 3),
    "shorter block": (block, 3),
    "small block": (block, 3),
    "line": (line, 2),
    "three-sided rectangle": (three_sided_rectangle, 2),
    "square": (square, 2),
    "container": (container, 3),
}
"""Builders from size times scale, and the number of lengths that they use."""
