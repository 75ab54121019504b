"""Building blocks of procedural shapes: prisms, bodies of revolution, and their collision hulls.

Textures are draped over a shape from above: top faces are undistorted, side faces continue the image
downwards from their upper edge.
"""

from collections.abc import Sequence

import numpy as np

from openvima.catalog.geometry import CollisionHull, Geometry, TriangleMesh, Vector3
from openvima.errors import ShapeError

TEXTURE_PER_M = 3.5
"""Texture widths per metre of surface, much as on the kit objects of the original pack."""

_MIN_TEXTURE_FRACTION = 0.25  # of the texture's width; a 3 cm block shows this much instead of a tenth
_TRIANGLES_PER_BOX = 12


def prism(
    loops: Sequence[np.ndarray], z_low: float, z_high: float, *, texture_per_m: float = TEXTURE_PER_M
) -> TriangleMesh:
    """Extrude an outline upwards, with flat faces and sharp edges.

    Args:
        loops: Outer loop counter-clockwise, then holes clockwise; each shape (N, 2), metres.
        z_low: Height of the lower face.
        z_high: Height of the upper face.
        texture_per_m: Texture widths per metre; the middle of the image is at the origin.
    """
    points = np.concatenate(loops)
    corners = triangulate(loops)
    faces = []
    for z, flat, up in ((z_high, points[corners], 1.0), (z_low, points[corners[:, ::-1]], -1.0)):
        vertices = _at_height(flat, z)
        normals = np.broadcast_to([0.0, 0.0, up], vertices.shape)
        faces.append(TriangleMesh(vertices, normals, 0.5 + texture_per_m * flat))
    return combine([*faces, *(_side_walls(loop, z_low, z_high, texture_per_m) for loop in loops)])


def revolve(
    profile: Sequence[tuple[float, float]], num_sides: int, *, texture_radii: Sequence[float]
) -> TriangleMesh:
    """Turn a profile about the z axis, with normals that blend smoothly along and around it.

    Args:
        profile: Radius and height of successive points, metres; the outside is on the right, so
            an outer wall runs upwards and a floor inwards.
        num_sides: Number of flat sides around.
        texture_radii: Distance from the middle of the image, in texture widths, at each point of the profile.
    """
    points = np.array(profile, dtype=np.float64)
    steps = np.diff(points, axis=0)
    ring_normals = np.stack([steps[:, 1], -steps[:, 0]], axis=1)
    ring_normals /= np.linalg.norm(ring_normals, axis=1, keepdims=True)
    parts = []
    for i in range(len(steps)):
        start = ring_normals[max(i - 1, 0)] + ring_normals[i]
        end = ring_normals[min(i + 1, len(steps) - 1)] + ring_normals[i]
        ring = np.stack([points[i], points[i + 1]])
        radii = np.array(texture_radii[i : i + 2], dtype=np.float64)
        parts.append(_revolved_ring(ring, np.stack([start, end]), radii, num_sides))
    return combine(parts)


def combine(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Put several meshes together, in order."""
    parts = ("vertices", "normals", "uvs")
    return TriangleMesh(*(np.concatenate([getattr(mesh, part) for mesh in meshes]) for part in parts))


def scale_mesh(mesh: TriangleMesh, scale: Vector3) -> TriangleMesh:
    """Stretch a mesh along the axes; its texture stretches with it."""
    if scale == (1.0, 1.0, 1.0):
        return mesh
    factors = np.array(scale)
    normals = mesh.normals / factors
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    return TriangleMesh(mesh.vertices * factors, normals, mesh.uvs)


def scale_geometry(geometry: Geometry, scale: Vector3) -> Geometry:
    """Stretch a shape along the axes: what is drawn, its hulls and the height at which it rests."""
    if scale == (1.0, 1.0, 1.0):
        return geometry
    hulls = tuple(CollisionHull(shape.points * scale) for shape in geometry.collision)
    return Geometry(scale_mesh(geometry.visual, scale), hulls, geometry.rest_z_m * scale[2])


def drape(mesh: TriangleMesh) -> TriangleMesh:
    """Drape one texture over a group of boxes from above, finer on small ones, within its borders.

    Args:
        mesh: Boxes of 12 triangles each, as `box_mesh` builds them.
    """
    tops = mesh.vertices.reshape(-1, _TRIANGLES_PER_BOX * 3, 3)[..., 2].max(axis=1)
    drop = np.repeat(tops, _TRIANGLES_PER_BOX)[:, None] - mesh.vertices[..., 2]
    flat = mesh.vertices[..., :2] + drop[..., None] * mesh.normals[..., :2]
    extents = np.ptp(mesh.vertices[..., :2].reshape(-1, 2), axis=0)
    density = min(max(TEXTURE_PER_M, _MIN_TEXTURE_FRACTION / extents.max()), 0.5 / np.abs(flat).max())
    return TriangleMesh(mesh.vertices, mesh.normals, 0.5 + density * flat)


def _at_height(points: np.ndarray, z: float) -> np.ndarray:
    return np.concatenate([points, np.full((*points.shape[:-1], 1), z)], axis=-1)


def _side_walls(loop: np.ndarray, z_low: float, z_high: float, texture_per_m: float) -> TriangleMesh:
    """Two triangles for each edge; the solid is on the left of the loop."""
    start, end = loop, np.roll(loop, -1, axis=0)
    outward = np.stack([end[:, 1] - start[:, 1], start[:, 0] - end[:, 0]], axis=1)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    folded = outward * (z_high - z_low)  # where the lower edge would be if the wall were folded up flat
    corners = ((start, z_low), (end, z_low), (end, z_high), (start, z_high))
    positions = [_at_height(point, z) for point, z in corners]
    vertices, flat = (
        np.concatenate([np.stack([corners[i] for i in each], axis=1) for each in ((0, 1, 2), (0, 2, 3))])
        for corners in (positions, [start + folded, end + folded, end, start])
    )
    normals = np.tile(_at_height(outward, 0.0)[:, None], (2, 3, 1))
    return TriangleMesh(vertices, normals, 0.5 + texture_per_m * flat)


def _revolved_ring(
    ring: np.ndarray, normals: np.ndarray, texture_radii: np.ndarray, num_sides: int
) -> TriangleMesh:
    """Faces between two circles.

    Args:
        ring: Radius and height of the first and the second circle, shape (2, 2).
        normals: Radial and upward part of the normal at both, shape (2, 2), any length.
        texture_radii: Distance from the middle of the image at both, shape (2,).
        num_sides: Number of flat sides.
    """
    angles = 2 * np.pi * np.arange(num_sides + 1) / num_sides
    around = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 9)  # equal bits on any machine
    around[-1] = around[0]
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def corner(level: int, side: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        direction = around[side : side + num_sides]
        position, normal = (_at_height(direction * part[level, 0], part[level, 1]) for part in (ring, unit))
        return position, normal, 0.5 + texture_radii[level] * direction

    faces = []
    if ring[0, 0] > 0:
        faces.append((corner(0, 0), corner(0, 1), corner(1, 1)))
    if ring[1, 0] > 0:
        faces.append((corner(0, 0), corner(1, 1), corner(1, 0)))
    return combine([TriangleMesh(*(np.stack(part, axis=1) for part in zip(*f, strict=True))) for f in faces])


Point = tuple[float, float]


def signed_area(loop: np.ndarray) -> float:
    """Return the area of a closed polygon, positive if it runs counter-clockwise.

    Args:
        loop: Corners, shape (N, 2); the last one joins the first.
    """
    x, y = loop[:, 0], loop[:, 1]
    return float(0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def triangulate(loops: Sequence[np.ndarray]) -> np.ndarray:
    """Cut an outline into triangles that cover it exactly.

    Args:
        loops: The outer loop counter-clockwise, then holes clockwise; each shape (N, 2). Loops neither cross
            nor touch.

    Returns:
        Shape (T, 3), int64: indices into all loops put one after the other, each triangle counter-clockwise.

    Raises:
        ShapeError: A loop crosses itself or another one.
    """
    points = [(x, y) for x, y in np.concatenate(loops).tolist()]
    starts = np.cumsum([0, *(len(loop) for loop in loops)])
    rings = [list(range(starts[i], starts[i + 1])) for i in range(len(loops))]
    polygon = _without_holes(points, rings)
    return np.array(_clip_ears(points, polygon), dtype=np.int64)


def _turn(a: Point, b: Point, c: Point) -> float:
    """Doubled area of the triangle a, b, c; positive for a left turn."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _without_holes(points: list[Point], rings: list[list[int]]) -> list[int]:
    """Join each hole to the outer loop by a pair of coinciding edges."""
    polygon = rings[0]
    holes = sorted(rings[1:], key=lambda ring: max(points[i][0] for i in ring), reverse=True)
    for done, hole in enumerate(holes):
        start = max(range(len(hole)), key=lambda k: points[hole[k]])
        turned = hole[start:] + hole[: start + 1]
        loops = (polygon, *holes[done:])
        edges = [edge for ring in loops for edge in zip(ring, ring[1:] + ring[:1], strict=True)]
        place = _visible_corner(points, polygon, turned[0], edges)
        polygon = polygon[: place + 1] + turned + polygon[place:]
    return polygon


def _visible_corner(
    points: list[Point], polygon: list[int], hole_corner: int, edges: list[tuple[int, int]]
) -> int:
    """Place in `polygon` of the nearest corner that no edge hides from a corner of a hole."""
    origin, corners = points[hole_corner], [points[index] for index in polygon]
    squared = [(x - origin[0]) ** 2 + (y - origin[1]) ** 2 for x, y in corners]
    for place in sorted(range(len(polygon)), key=squared.__getitem__):
        target = corners[place]
        if not any(_crosses(origin, target, points[a], points[b]) for a, b in edges):
            return place
    raise ShapeError("a hole lies outside its outline.")


def _crosses(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether two segments meet anywhere but at a common end."""
    if a in (c, d) or b in (c, d):
        return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0 and _turn(c, d, a) * _turn(c, d, b) <= 0


def _clip_ears(points: list[Point], polygon: list[int]) -> list[tuple[int, int, int]]:
    triangles = []
    while len(polygon) > 3:
        for place in range(len(polygon)):
            before, tip, after = polygon[place - 1], polygon[place], polygon[(place + 1) % len(polygon)]
            if _is_ear(points, polygon, (before, tip, after)):
                triangles.append((before, tip, after))
                del polygon[place]
                break
        else:
            raise ShapeError(f"no ear among the last {len(polygon)} corners; does the outline cross itself?")
    triangles.append((polygon[0], polygon[1], polygon[2]))
    return triangles


def _is_ear(points: list[Point], polygon: list[int], corners: tuple[int, int, int]) -> bool:
    a, b, c = (points[i] for i in corners)
    others = (p for p in (points[i] for i in polygon) if p not in (a, b, c))
    return _turn(a, b, c) > 0 and not any(
        _turn(a, b, p) >= 0 and _turn(b, c, p) >= 0 and _turn(c, a, p) >= 0 for p in others
    )
