"""Random shapes: flat prisms with irregular outlines, and containers, independent of the catalogue."""

import numpy as np

from openvima.catalog import bodies
from openvima.catalog.geometry import Geometry
from openvima.catalog.meshes import combine, drape, prism, revolve, signed_area

_WIDTHS_M = (0.07, 0.125)  # smallest and largest extent of an outline, much as of the kit objects
_HEIGHTS_M = (0.02, 0.036)
_MICROMETRES = 6
_NUM_RADII, _NUM_ANGLES = 14, 72  # grid on which a shape is compared with its rotations
_SMALLEST_TURN = 5  # of these angles; smaller rotations are never distinguishable
_CORNERS = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])  # of a rectangle, counter-clockwise
_LEAST_DIFFERENCE = 0.15  # fraction of the area; 0.18 for the heart, 0.05 for the star

Cell = tuple[int, int]
Loops = tuple[np.ndarray, ...]
"""An outline: a loop counter-clockwise, then holes clockwise, each of shape (N, 2), float64, metres."""


def random_shape(rng: np.random.Generator) -> Geometry:
    """Sample a flat prism, origin at its bottom, without collision."""
    return Geometry(prism(random_outline(rng), 0.0, rng.uniform(*_HEIGHTS_M)))


def random_ring(rng: np.random.Generator) -> Geometry:
    """Sample a flat prism, round outside and with a hole of any form, without collision."""
    radius = rng.uniform(*_WIDTHS_M) / 2
    outer = radius * _polar(np.ones(36), 2 * np.pi * np.arange(36) / 36)
    hole = (_blob if rng.random() < 0.5 else _polygon)(rng)[0]
    hole = hole * radius * rng.uniform(0.35, 0.75) / np.linalg.norm(hole, axis=1).max()
    return Geometry(prism([outer, hole[::-1]], 0.0, rng.uniform(*_HEIGHTS_M)))


def random_block(rng: np.random.Generator) -> Geometry:
    """Sample a block whose sides are at most as 1 to 1.2, without collision."""
    side, ratio = rng.uniform(0.045, 0.11), rng.uniform(1 / 1.2, 1.0)
    outline = side / 2 * np.array([1.0, ratio]) * _CORNERS
    return Geometry(prism([outline], 0.0, rng.uniform(0.02, 0.06)))


def random_container(rng: np.random.Generator) -> Geometry:
    """Sample an open box, a tray, a bowl, a frame or a flat square, without collision."""
    return _CONTAINERS[int(rng.integers(len(_CONTAINERS)))](rng)


def random_grating(rng: np.random.Generator) -> Geometry:
    """Sample a container of slats, origin at its bottom, without collision.

    The gaps are real: they turn with the container, and seen obliquely they close.
    """
    length, width = rng.uniform(0.12, 0.2, 2).tolist()
    beam, slat = rng.uniform(0.003, 0.02, 2).tolist()
    num_slats, num_beams = int(rng.integers(3, 9)), int(rng.integers(2, 5))
    slat_width, beam_width = width / num_slats * rng.uniform(0.35, 0.75), rng.uniform(0.008, 0.02)
    parts = [
        bodies.box((beam_width, width, beam), (x, 0.0, beam / 2))
        for x in _spread(length, beam_width, num_beams)
    ]
    parts += [
        bodies.box((length, slat_width, slat), (0.0, y, beam + slat / 2))
        for y in _spread(width, slat_width, num_slats)
    ]
    if rng.random() < 0.3:  # slats upright around it
        height = rng.uniform(0.02, 0.05)
        parts += [
            bodies.box((beam_width, bodies.WALL_M, height), (x, y, height / 2))
            for x in _spread(length, beam_width, num_slats)
            for y in (-width / 2, width / 2)
        ]
    return Geometry(drape(bodies.box_mesh(parts)))


def random_eared_container(rng: np.random.Generator) -> Geometry:
    """Sample a container with two opposite ears at its rim, without collision."""
    body = random_container(rng)
    points = body.visual.vertices.reshape(-1, 3)
    axis, top = int(rng.integers(2)), points[:, 2].max()
    length, width, height = rng.uniform(0.01, 0.03), rng.uniform(0.02, 0.06), rng.uniform(0.003, 0.012)
    half = np.array([length / 2 + 0.004, width / 2])[[axis, 1 - axis]]  # 8 mm of it inside the rim
    ears = []
    for rim, sign in ((points[:, axis].min(), -1), (points[:, axis].max(), 1)):
        centre = np.zeros(2)
        centre[axis] = rim + sign * (length / 2 - 0.004)
        ears.append(
            prism([centre + half * _CORNERS], top - min(height, np.ptp(points[:, 2])), top, texture_per_m=2.9)
        )
    return Geometry(combine([body.visual, *ears]), rest_z_m=body.rest_z_m)


def random_square_container(rng: np.random.Generator) -> Geometry:
    """Sample a container whose outline is a rectangle, without collision."""
    return (_open_box, _flat_square, random_grating)[int(rng.integers(3))](rng)


def random_round_container(rng: np.random.Generator) -> Geometry:
    """Sample a bowl whose outline is a circle, without collision."""
    return _bowl(rng, sides=26)


def random_outline(rng: np.random.Generator) -> Loops:
    """Draw an outline: a star, a polygon, a blob, a ring, or strokes like those of a letter."""
    loops = _OUTLINES[int(rng.integers(len(_OUTLINES)))](rng)
    low, high = loops[0].min(axis=0), loops[0].max(axis=0)
    stretch = np.array([rng.uniform(0.75, 1.0), 1.0])
    scale = rng.uniform(*_WIDTHS_M) / ((high - low) * stretch).max()
    placed = [np.round((loop - (low + high) / 2) * stretch * scale, _MICROMETRES) for loop in loops]
    return tuple(
        loop if (signed_area(loop) > 0) == (number == 0) else loop[::-1].copy()
        for number, loop in enumerate(placed)
    )


def has_heading(loops: Loops) -> bool:
    """Whether an outline differs clearly from its rotations, so that its yaw is visible."""
    middle = _centroid(loops)
    reach = float(np.linalg.norm(loops[0] - middle, axis=1).max())
    radii = reach * (np.arange(_NUM_RADII) + 0.5) / _NUM_RADII
    angles = 2 * np.pi * np.arange(_NUM_ANGLES) / _NUM_ANGLES
    grid = middle + radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    inside = _inside(grid.reshape(-1, 2), loops).reshape(_NUM_RADII, _NUM_ANGLES)
    area = (inside * radii[:, None]).sum()
    differences = [
        ((inside ^ np.roll(inside, turn, axis=1)) * radii[:, None]).sum() / area
        for turn in range(_SMALLEST_TURN, _NUM_ANGLES // 2 + 1)
    ]
    return bool(min(differences) >= _LEAST_DIFFERENCE)


def _centroid(loops: Loops) -> np.ndarray:
    """Centroid of the area inside an outline, shape (2,)."""
    start, end = _sides(loops)
    parts = start[:, 0] * end[:, 1] - end[:, 0] * start[:, 1]  # of triangles with the origin, holes negative
    return ((start + end) * parts[:, None]).sum(axis=0) / (3 * parts.sum())


def _inside(points: np.ndarray, loops: Loops) -> np.ndarray:
    """Whether points are inside an outline and in none of its holes, shape (N,), bool; by crossings."""
    start, end = _sides(loops)
    x, y = points[:, :1], points[:, 1:]
    spans = (start[:, 1] > y) != (end[:, 1] > y)
    rise = np.where(start[:, 1] == end[:, 1], 1.0, end[:, 1] - start[:, 1])
    crossing = start[:, 0] + (y - start[:, 1]) * (end[:, 0] - start[:, 0]) / rise
    return (spans & (x < crossing)).sum(axis=1) % 2 == 1


def _sides(loops: Loops) -> tuple[np.ndarray, np.ndarray]:
    """First and second end of each side of an outline, both of shape (N, 2)."""
    return np.concatenate(loops), np.concatenate([np.roll(loop, -1, axis=0) for loop in loops])


def _polar(radii: np.ndarray, angles: np.ndarray) -> np.ndarray:
    return np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)


def _jittered_angles(rng: np.random.Generator, count: int) -> np.ndarray:
    steps = np.arange(count) + rng.uniform(-0.2, 0.2, count)  # less than 180 degrees between two
    return 2 * np.pi * steps / count + rng.uniform(0, 2 * np.pi)


def _star(rng: np.random.Generator) -> list[np.ndarray]:
    tips = int(rng.integers(3, 8))
    radii = rng.uniform(0.7, 1.2, 2 * tips)
    radii[1::2] *= rng.uniform(0.3, 0.7)
    return [_polar(radii, _jittered_angles(rng, 2 * tips))]


def _polygon(rng: np.random.Generator) -> list[np.ndarray]:
    count = int(rng.integers(3, 8))
    return [_polar(rng.uniform(0.55, 1.1, count), _jittered_angles(rng, count))]


def _blob(rng: np.random.Generator) -> list[np.ndarray]:
    angles = 2 * np.pi * np.arange(36) / 36
    radii = np.ones(36)
    for waves in range(1, 6):
        radii += rng.uniform(0, 0.35) / waves**0.5 * np.cos(waves * angles + rng.uniform(0, 2 * np.pi))
    return [_polar(np.maximum(radii, 0.25), angles)]


def _ring(rng: np.random.Generator) -> list[np.ndarray]:
    """A polygon or blob with a hole of its own form, smaller or larger, often to one side."""
    outer = (_blob if rng.random() < 0.5 else _polygon)(rng)[0]
    hole = outer * rng.uniform(0.25, 0.6)
    return [outer, hole[::-1]]


def _strokes(rng: np.random.Generator) -> list[np.ndarray]:
    """Strokes of one width along a small grid, rounded or not, then slanted and tapered."""
    while True:
        cells = _random_cells(rng)
        is_straight = min(len({cell[axis] for cell in cells}) for axis in (0, 1)) < 2
        if not is_straight and not _touches_by_a_corner(cells):
            break
    loops = _borders(cells)
    if rng.random() < 0.5:
        loops = [_round_corners(_round_corners(loop)) for loop in loops]
    slant, taper = rng.uniform(-0.35, 0.35), rng.uniform(-0.12, 0.12)
    stretch = rng.uniform(0.7, 1.4)

    def bent(loop: np.ndarray) -> np.ndarray:
        x, y = loop[:, 0] - 1.5, loop[:, 1] - 1.5
        return np.stack([x * stretch * (1 + taper * y) + slant * y, y], axis=1)

    loops.sort(key=lambda loop: -abs(signed_area(loop)))
    return [bent(loop) for loop in loops]


def _random_cells(rng: np.random.Generator) -> set[Cell]:
    """Cells of a grid that hang together: a walk in straight strokes, perhaps with a branch."""
    side = int(rng.integers(3, 6))
    cells: set[Cell] = {(int(rng.integers(side)), int(rng.integers(side)))}
    for _ in range(int(rng.integers(2, 6))):
        x, y = sorted(cells)[int(rng.integers(len(cells)))]
        dx, dy = ((1, 0), (-1, 0), (0, 1), (0, -1))[int(rng.integers(4))]
        for _ in range(int(rng.integers(2, side + 1))):
            if not (0 <= x < side and 0 <= y < side):
                break
            cells.add((x, y))
            x, y = x + dx, y + dy
    return cells


def _round_corners(loop: np.ndarray) -> np.ndarray:
    """Cut every corner at a quarter of its sides.

    Source: Chaikin, "An algorithm for high speed curve generation" (1974).
    """
    following = np.roll(loop, -1, axis=0)
    return np.stack([0.75 * loop + 0.25 * following, 0.25 * loop + 0.75 * following], axis=1).reshape(-1, 2)


def _touches_by_a_corner(cells: set[Cell]) -> bool:
    return any(
        (x + dx, y + 1) in cells and (x + dx, y) not in cells and (x, y + 1) not in cells
        for x, y in cells
        for dx in (-1, 1)
    )


def _borders(cells: set[Cell]) -> list[np.ndarray]:
    """Closed loops around cells, with the cells on their left, corners only.

    `following` leads from corner to corner along the sides without a neighbour. It is a function, as no two
    cells touch by a corner alone. Corners between two collinear sides are dropped.
    """
    following: dict[Cell, Cell] = {}
    for x, y in cells:
        corners = ((x, y), (x + 1, y), (x + 1, y + 1), (x, y + 1))
        beside = ((x, y - 1), (x + 1, y), (x, y + 1), (x - 1, y))
        for side in range(4):
            if beside[side] not in cells:
                following[corners[side]] = corners[(side + 1) % 4]
    loops = []
    while following:
        corner = min(following)
        loop = [corner]
        while (corner := following.pop(corner)) != loop[0]:
            loop.append(corner)
        points = np.array(loop, dtype=np.float64)
        before, after = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
        loops.append(points[np.abs(before - after).sum(axis=1) > 0])
    return loops


def _open_box(rng: np.random.Generator) -> Geometry:
    x, y = rng.uniform(0.12, 0.2, 2).tolist()
    return _drape(bodies.container((x, y, rng.uniform(0.015, 0.07))))


def _spread(length: float, part: float, count: int) -> list[float]:
    """Return the middles of equal parts, the first and last of which end at the borders."""
    return np.linspace((part - length) / 2, (length - part) / 2, count).tolist()


def _flat_square(rng: np.random.Generator) -> Geometry:
    return _drape(bodies.square((rng.uniform(0.12, 0.2), rng.uniform(0.015, 0.05), 0.001)))


def _drape(boxes: Geometry) -> Geometry:
    return Geometry(drape(boxes.visual), rest_z_m=boxes.rest_z_m)


def _frame(rng: np.random.Generator) -> Geometry:
    if rng.random() < 0.5:
        outer = rng.uniform(0.06, 0.1, 2) * _CORNERS
    else:
        count = int(rng.integers(3, 9))
        outer = _polar(np.full(count, rng.uniform(0.075, 0.105)), _jittered_angles(rng, count))
    hole = outer * rng.uniform(0.55, 0.9)
    return Geometry(prism([outer, hole[::-1]], 0.0, rng.uniform(0.0015, 0.03), texture_per_m=2.9))


def _bowl(rng: np.random.Generator, sides: int | None = None) -> Geometry:
    foot, rim = rng.uniform(0.04, 0.075), rng.uniform(0.075, 0.105)
    height, wall = rng.uniform(0.02, 0.075), rng.uniform(0.003, 0.02)
    belly = (foot + rim) / 2 + rng.uniform(-0.01, 0.015)
    profile = [
        (0.0, 0.0),
        (foot, 0.0),
        (belly, height / 2),
        (rim, height),
        (rim - wall, height),
        (belly - wall, height / 2),
        (foot - wall, 0.008),
        (0.0, 0.008),
    ]
    sides = sides or int(rng.choice((4, 6, 8, 26)))
    radii = [2.5 * (r + (height - z if number < 4 else 0.0)) for number, (r, z) in enumerate(profile)]
    return Geometry(revolve(profile, sides, texture_radii=radii))


_OUTLINES = (_star, _polygon, _blob, _ring, _strokes, _strokes, _strokes)
_CONTAINERS = (_open_box, _flat_square, _frame, _bowl)
RANDOM_SHAPES = {
    "shape": random_shape,
    "ring": random_ring,
    "block": random_block,
    "container": random_container,
    "grating": random_grating,
    "eared container": random_eared_container,
    "square container": random_square_container,
    "round container": random_round_container,
}
"""What draws a shape of each kind."""
