"""Cutting flat outlines with holes into triangles by ear clipping."""

from collections.abc import Sequence

import numpy as np

from openvima.errors import ShapeError

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
        ShapeError: A loop crosses itself or another one, or runs the wrong way round.
    """
    points = [(float(x), float(y)) for loop in loops for x, y in loop]
    starts = np.cumsum([0, *(len(loop) for loop in loops)])
    rings = [list(range(starts[i], starts[i + 1])) for i in range(len(loops))]
    areas = [signed_area(loop) for loop in loops]
    if areas[0] <= 0 or any(area >= 0 for area in areas[1:]):
        raise ShapeError(f"loop areas are {areas}; the first must be positive, those of holes negative.")
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
        edges = [edge for ring in (polygon, *holes[done:]) for edge in _edges(ring)]
        place = _visible_corner(points, polygon, turned[0], edges)
        polygon = polygon[: place + 1] + turned + polygon[place:]
    return polygon


def _edges(ring: list[int]) -> list[tuple[int, int]]:
    return list(zip(ring, ring[1:] + ring[:1], strict=True))


def _visible_corner(
    points: list[Point], polygon: list[int], hole_corner: int, edges: list[tuple[int, int]]
) -> int:
    """Place in `polygon` of the nearest corner that no edge hides from a corner of a hole."""
    origin = points[hole_corner]

    def distance(place: int) -> float:
        x, y = points[polygon[place]]
        return (x - origin[0]) ** 2 + (y - origin[1]) ** 2

    for place in sorted(range(len(polygon)), key=distance):
        target = points[polygon[place]]
        if not any(_crosses(origin, target, points[a], points[b]) for a, b in edges):
            return place
    raise ShapeError("a hole lies outside its outline.")


def _crosses(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether two segments meet anywhere but at a common end."""
    if a in (c, d) or b in (c, d):
        return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0 and _turn(c, d, a) * _turn(c, d, b) <= 0


def _clip_ears(points: list[Point], polygon: list[int]) -> list[tuple[int, int, int]]:
    polygon = list(polygon)
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
    if _turn(a, b, c) <= 0:
        return False
    for index in polygon:
        p = points[index]
        if p in (a, b, c):
            continue
        if _turn(a, b, p) >= 0 and _turn(b, c, p) >= 0 and _turn(c, a, p) >= 0:
            return False
    return True
