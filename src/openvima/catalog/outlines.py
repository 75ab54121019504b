"""Outlines of the 18 kit objects (outlines.json), seen from above, and their triangulation by ear clipping.

Outlines have x to the right and y up, in metres at the size in use. Letters stand upright (+y up). Unlike in
the original pack this holds for the T, too: rotations are always relative, so it only affects the appearance.
"""

import json
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from openvima.errors import AssetError, ShapeError

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


Loop = list[tuple[float, float]]


@cache
def _outlines() -> dict[str, list[Loop]]:
    return json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))


def outline(object_name: str) -> tuple[np.ndarray, ...]:
    """Return the outline of a kit object.

    Args:
        object_name: Display name, such as "letter A".

    Returns:
        Loops of shape (N, 2), float64: the outer one counter-clockwise, then holes clockwise.

    Raises:
        AssetError: The object is no kit object.

    Example:
        >>> [len(loop) for loop in outline("letter A")]
        [8, 3]
    """
    if object_name not in _outlines():
        raise AssetError(f"{object_name!r} has no outline; there is one for {', '.join(_outlines())}.")
    return tuple(np.array(loop, np.float64) for loop in _outlines()[object_name])


def regular_polygon(
    num_corners: int, radius: float, *, first_rad: float = 0.0, centre: tuple[float, float] = (0.0, 0.0)
) -> Loop:
    """Return the corners of a regular polygon, the first one in the direction `first_rad`."""
    angles = [first_rad + 2 * math.pi * i / num_corners for i in range(num_corners)]
    return [(centre[0] + radius * math.cos(a), centre[1] + radius * math.sin(a)) for a in angles]


def rectangle(centre: tuple[float, float], half_size: tuple[float, float]) -> Loop:
    """Return the corners of an upright rectangle, counter-clockwise."""
    (x, y), (dx, dy) = centre, half_size
    return [(x - dx, y - dy), (x + dx, y - dy), (x + dx, y + dy), (x - dx, y + dy)]


def arc(
    centre: tuple[float, float], radii: tuple[float, float], degrees: tuple[float, float], num_points: int
) -> Loop:
    """Return points on an arc of an upright ellipse, both ends included."""
    angles = np.deg2rad(np.linspace(degrees[0], degrees[1], num_points))
    return [(centre[0] + radii[0] * math.cos(a), centre[1] + radii[1] * math.sin(a)) for a in angles]
