"""Outlines of the 18 kit objects, seen from above, and their triangulation by ear clipping.

Outlines have x to the right and y up, in metres at the size in use. Letters stand upright (+y up). Unlike in
the original pack this holds for the T, too: rotations are always relative, so it only affects the appearance.
"""

import math
from collections.abc import Callable, Sequence

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

_MICROMETRES = 6  # rounding to decimals makes the coordinates equal bits with any mathematics library


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
    if object_name not in _OUTLINES:
        raise AssetError(f"{object_name!r} has no outline; there is one for {', '.join(_OUTLINES)}.")
    loops = [np.round(np.array(loop, dtype=np.float64), _MICROMETRES) for loop in _OUTLINES[object_name]()]
    wanted = [1.0, *([-1.0] * (len(loops) - 1))]
    return tuple(
        loop if signed_area(loop) * sign > 0 else loop[::-1].copy()
        for loop, sign in zip(loops, wanted, strict=True)
    )


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


def _mirror(right_half: Sequence[tuple[float, float]]) -> Loop:
    """Close a right half, listed from bottom to top, by its mirror image; points on the axis stay single."""
    return [*right_half, *[(-x, y) for x, y in reversed(right_half) if x != 0]]


def _letter_a() -> list[Loop]:
    x, y, apex, leg = 0.0449, 0.05126, 0.0086, 0.0213
    bar_low, bar_high = -0.022, -0.004
    slope = (x - apex) / (2 * y)  # how far a leg moves inwards per metre of height

    def inner(height: float) -> float:
        return x - leg - slope * (height + y)

    notch = [(inner(bar_low), bar_low), (x - leg, -y)]
    top = (x - leg) / slope - y
    return [
        _mirror([*notch, (x, -y), (apex, y)]),
        [(inner(bar_high), bar_high), (0.0, top), (-inner(bar_high), bar_high)],
    ]


def _letter_e() -> list[Loop]:
    x, y, spine, arm = 0.02876, 0.05107, 0.0211, 0.0199
    inside, middle = spine - x, 0.0264
    return [
        [
            (-x, -y),
            (x, -y),
            (x, arm - y),
            (inside, arm - y),
            (inside, -0.0079),
            (middle, -0.0079),
            (middle, 0.0120),
            (inside, 0.0120),
            (inside, y - arm),
            (x, y - arm),
            (x, y),
            (-x, y),
        ]
    ]


def _letter_g() -> list[Loop]:
    x, y, stroke = 0.04083, 0.05238, 0.0216
    centre, outer = (0.005, 0.0), (0.04583, y)
    inner = (outer[0] - stroke, outer[1] - stroke)
    bar_low, bar_high = -0.0125, 0.0065
    spur = x - stroke + 0.001
    low_end = math.degrees(math.acos((x - centre[0]) / outer[0]))
    inner_low = math.degrees(math.acos((spur - centre[0]) / inner[0]))
    return [
        [
            *arc(centre, outer, (39, 360 - low_end), 24),
            (x, bar_high),
            (0.0, bar_high),
            (0.0, bar_low),
            (spur, bar_low),
            *arc(centre, inner, (360 - inner_low, 39), 18),
        ]
    ]


def _letter_m() -> list[Loop]:
    x, y, stem = 0.04589, 0.04823, 0.0202
    notch, shoulder, point = -0.013, 0.027, 0.007
    armpit = 0.0122
    right = [
        (point, -y),
        (x - stem, armpit),
        (x - stem, -y),
        (x, -y),
        (x, y),
        (x - shoulder, y),
        (0.0, notch),
    ]
    return [_mirror(right)]


def _letter_r() -> list[Loop]:
    x, y, stem = 0.03646, 0.05107, 0.0205
    left, inside = -x, stem - x
    bowl_low, bowl_right, counter_low, counter_high = -0.0105, 0.0330, 0.0085, 0.0330
    bowl = (bowl_low + y) / 2, (y - bowl_low) / 2  # middle and half height
    counter = (counter_low + counter_high) / 2, (counter_high - counter_low) / 2
    outer_arc = arc((bowl_right - bowl[1], bowl[0]), (bowl[1], bowl[1]), (-62, 90), 12)
    counter_arc = arc((0.0005, counter[0]), (0.0125, counter[1]), (-90, 90), 8)
    return [
        [
            (left, -y),
            (inside, -y),
            (inside, bowl_low),
            (-0.0085, bowl_low),
            (x - 0.0232, -y),
            (x, -y),
            *outer_arc,
            (left, y),
        ],
        [(inside, counter_low), *counter_arc, (inside, counter_high)],
    ]


def _letter_t() -> list[Loop]:
    half, width = 0.054, 0.0324
    bar = half - width
    return [_mirror([(width / 2, -half), (width / 2, bar), (half, bar), (half, half)])]


def _letter_v() -> list[Loop]:
    x, y, foot, leg = 0.04226, 0.05107, 0.0078, 0.0218
    slope = (x - foot) / (2 * y)
    return [_mirror([(foot, -y), (x, y), (x - leg, y), (0.0, y - (x - leg) / slope)])]


def _cross() -> list[Loop]:
    a, b = 0.024, 0.048
    return [
        [
            (a, -b),
            (a, -a),
            (b, -a),
            (b, a),
            (a, a),
            (a, b),
            (-a, b),
            (-a, a),
            (-b, a),
            (-b, -a),
            (-a, -a),
            (-a, -b),
        ]
    ]


def _flower() -> list[Loop]:
    radius = 0.027
    petals = []
    for heading in (0, 90, 180, 270):
        centre = (radius * math.cos(math.radians(heading)), radius * math.sin(math.radians(heading)))
        petals += arc(centre, (radius, radius), (heading - 90, heading + 90), 11)[:-1]
    return [petals]


def _heart() -> list[Loop]:
    x, y, radius = 0.05172, 0.0475, 0.02785
    centre = (x - radius, y - radius)
    bulge = (x, -0.0105)  # control point of the flank, from the tip to where the lobe is widest
    flank = [
        (
            2 * t * (1 - t) * bulge[0] + t * t * x,
            (1 - t) ** 2 * -y + 2 * t * (1 - t) * bulge[1] + t * t * centre[1],
        )
        for t in np.linspace(0, 1, 8)[:-1]
    ]
    notch_deg = math.degrees(math.acos(-centre[0] / radius))
    lobe = arc(centre, (radius, radius), (0, notch_deg), 13)
    lobe[-1] = (0.0, lobe[-1][1])
    return [_mirror([*flank, *lobe])]


def _l_shaped_block() -> list[Loop]:
    half, width = 0.048, 0.0288
    inside = width - half
    return [[(-half, -half), (half, -half), (half, inside), (inside, inside), (inside, half), (-half, half)]]


def _star() -> list[Loop]:
    centre = (-0.0055, 0.0)
    tips = regular_polygon(5, 0.0572, centre=centre)
    hollows = regular_polygon(5, 0.0286, first_rad=math.pi / 5, centre=centre)
    return [[corner for pair in zip(tips, hollows, strict=True) for corner in pair]]


_OUTLINES: dict[str, Callable[[], list[Loop]]] = {
    "letter A": _letter_a,
    "letter E": _letter_e,
    "letter G": _letter_g,
    "letter M": _letter_m,
    "letter R": _letter_r,
    "letter T": _letter_t,
    "letter V": _letter_v,
    "cross": _cross,
    "diamond": lambda: [[(0.06, 0.0), (0.0, 0.048), (-0.06, 0.0), (0.0, -0.048)]],
    "triangle": lambda: [[(0.0, -0.048), (0.048, 0.048), (-0.048, 0.048)]],
    "flower": _flower,
    "heart": _heart,
    "hexagon": lambda: [regular_polygon(6, 0.054, first_rad=math.pi / 2)],
    "pentagon": lambda: [regular_polygon(5, 0.0541, first_rad=-math.pi / 2, centre=(0.0, 0.0052))],
    "L-shaped block": _l_shaped_block,
    "ring": lambda: [regular_polygon(32, 0.048), regular_polygon(16, 0.0205)],
    "round": lambda: [regular_polygon(40, 0.048)],
    "star": _star,
}
