"""Pictures of the parametric textures: stripes, polka dots, swirls, paisleys, checkerboard and rainbow.

Layouts follow those of the original images at a fraction of their size. Wherever it is easy, pixels come from
whole numbers, and else from comparisons far from a tie, so that images are bit-identical on every machine.
"""

import math

import numpy as np

from openvima.catalog.noise import hashed, layered_noise

Colour = tuple[int, int, int]

WHITE: Colour = (255, 255, 255)
BLACK: Colour = (1, 1, 1)

_STRIPES_PX, _STRIPE_PX = 320, 16
_DOTS_SHAPE = (320, 384)  # a fifth of the original
_SWIRL_SHAPE = (332, 331)  # half of the original
# Turn of the rays, degrees, by distance from the middle in pixels of the original.
_SWIRL_RADII = (0, 20, 40, 60, 80, 100, 140, 180, 220, 260, 300, 500)
_SWIRL_TURNS = (-1.0, -2.0, -3.7, -6.8, -10.9, -16.5, -30.6, -47.2, -64.4, -80.3, -94.6, -170.6)
_SWIRL_RAYS = 12
_RAINBOW_PX = 150
_RAINBOW = (
    (0, (255, 0, 198)),
    (12, (255, 0, 198)),
    (20, (233, 0, 192)),
    (30, (67, 1, 151)),
    (40, (0, 17, 149)),
    (50, (0, 102, 195)),
    (60, (1, 232, 252)),
    (70, (0, 213, 155)),
    (80, (0, 183, 72)),
    (90, (63, 201, 28)),
    (100, (184, 249, 5)),
    (110, (255, 243, 1)),
    (120, (254, 136, 0)),
    (130, (254, 0, 0)),
    (149, (254, 0, 0)),
)
_PAISLEY_PX, _PAISLEY_GRID = 256, 6
_PAISLEY_THINNEST = 6  # radius in sixteenths of a pixel: thinner tips would break into single pixels
_PAISLEY_WHITE: Colour = (254, 247, 240)


def two_colours(mask: np.ndarray, colour: Colour, ground: Colour) -> np.ndarray:
    """Return an image with `colour` where the mask is set and `ground` elsewhere, shape (H, W, 3), uint8."""
    return np.where(mask[..., None], np.array(colour, dtype=np.uint8), np.array(ground, dtype=np.uint8))


def stripe(first: Colour, second: Colour) -> np.ndarray:
    """Twenty vertical bands, the first colour at the left."""
    columns = np.arange(_STRIPES_PX) // _STRIPE_PX % 2 == 0
    return two_colours(np.broadcast_to(columns, (_STRIPES_PX, _STRIPES_PX)), first, second)


def polka_dot(dots: Colour, ground: Colour) -> np.ndarray:
    """Discs in eleven rows, alternately shifted by half their distance; a fifth of the area."""
    row, column = np.indices(_DOTS_SHAPE)
    mask = np.zeros(_DOTS_SHAPE, dtype=bool)
    for i in range(11):
        first, count = (458, 6) if i % 2 == 0 else (160, 7)  # tenths of a pixel
        for j in range(count):
            x, y = first + 5836 * j // 10, 160 + 288 * i
            mask |= (10 * column + 5 - x) ** 2 + (10 * row + 5 - y) ** 2 <= 102**2
    return two_colours(mask, dots, ground)


def swirl(colour: Colour) -> np.ndarray:
    """A pinwheel of twelve coloured and twelve white rays."""
    row, column = np.indices(_SWIRL_SHAPE)
    x, y = 2 * column + 1.0 - 329, 2 * row + 1.0 - 332
    turn_deg = np.interp(np.sqrt(x * x + y * y), _SWIRL_RADII, _SWIRL_TURNS)
    phase = np.arctan2(y, x) * _SWIRL_RAYS - np.deg2rad(turn_deg) * _SWIRL_RAYS
    return two_colours(np.cos(phase) > 0, colour, WHITE)


def checkerboard() -> np.ndarray:
    """Six by six squares of marble, the upper left one light."""
    side, square = 252, 42
    row, column = np.indices((side, side))
    light = (row // square + column // square) % 2 == 0
    veins = np.abs(layered_noise((side, side), (6, 6), seed=71, num_layers=3) - 0.5)
    change = np.where(veins < 0.02, -16, 0) + (12 * hashed(row, column, seed=72)).astype(np.int64) - 5
    base = np.where(light[..., None], (192, 186, 170), (76, 76, 71))
    return np.clip(base + change[..., None], 0, 255).astype(np.uint8)


def rainbow() -> np.ndarray:
    """Horizontal bands that blend into each other, violet on top, red at the bottom."""
    rows = np.arange(_RAINBOW_PX)
    places = [row for row, _ in _RAINBOW]
    channels = [np.interp(rows, places, [colour[c] for _, colour in _RAINBOW]) for c in range(3)]
    bands = (np.stack(channels, axis=1) + 1e-6).astype(np.uint8)
    return np.broadcast_to(bands[:, None], (_RAINBOW_PX, _RAINBOW_PX, 3)).copy()


def paisley(ground: Colour) -> np.ndarray:
    """Off-white drops with a curl and an inner ornament, flowers and dots; continues across its borders."""
    canvas = np.zeros((_PAISLEY_PX, _PAISLEY_PX), dtype=bool)
    for i in range(_PAISLEY_GRID**2):
        _paint_drop(canvas, i)
    for i in range(1500):
        _paint_filler(canvas, i)
    return two_colours(canvas, _PAISLEY_WHITE, ground)


# Sixteen headings as whole thousandths, so that drops stand on the same pixels everywhere.
_HEADINGS = tuple(
    (round(1000 * math.cos(k * math.pi / 8)), round(1000 * math.sin(k * math.pi / 8))) for k in range(16)
)


def _paint_drop(canvas: np.ndarray, index: int) -> None:
    """Paint one drop, in a jittered cell of a square grid whose rows are shifted alternately."""
    cell = _PAISLEY_PX * 16 // _PAISLEY_GRID  # in sixteenths of a pixel, like all lengths here
    row, column = divmod(index, _PAISLEY_GRID)
    dice = [float(hashed(index, k, seed=80)) for k in range(5)]
    x = column * cell + int((0.5 + 0.3 * (dice[0] - 0.5)) * cell) + (cell // 2 if row % 2 else 0)
    y = row * cell + int((0.5 + 0.3 * (dice[1] - 0.5)) * cell)
    heading, bend = int(16 * dice[2]), 1 if dice[3] < 0.5 else -1
    size = 160 + int(60 * dice[4])  # radius of the round end
    for share, value in ((272, False), (256, True), (172, False), (124, True), (44, False)):
        _paint_tapered(canvas, (x, y), heading, bend, size * share // 256, value)


def _paint_tapered(
    canvas: np.ndarray, centre: tuple[int, int], heading: int, bend: int, radius: int, value: bool
) -> None:
    """Paint discs that get smaller along a path that curls more and more."""
    x, y = centre
    steps = 20
    for step in range(steps):
        size = radius * (steps - step) // steps
        _paint_disc(canvas, (x, y), max(size, _PAISLEY_THINNEST) if value else size, value)
        dx, dy = _HEADINGS[(heading + bend * (step * step // 56)) % 16]
        stride = radius * 3 // 20
        x, y = x + dx * stride // 1000, y + dy * stride // 1000


def _paint_filler(canvas: np.ndarray, index: int) -> None:
    """Paint a flower, a small drop or a dot where there is still room for it."""
    x, y, kind, turn = (float(hashed(index, k, seed=81)) for k in range(4))
    centre = (int(x * _PAISLEY_PX) * 16 + 8, int(y * _PAISLEY_PX) * 16 + 8)
    reach = 160 if index < 300 else 110 if index < 700 else 54
    rows, columns, inside = _disc(centre, reach)
    if (canvas[np.ix_(rows, columns)] & inside).any():
        return
    if reach == 160:
        for dx, dy in _HEADINGS[::2]:
            _paint_disc(canvas, (centre[0] + dx * 88 // 1000, centre[1] + dy * 88 // 1000), 38, True)
        _paint_disc(canvas, centre, 42, True)
    elif reach == 110:
        _paint_tapered(canvas, centre, int(16 * turn), 1 if kind < 0.5 else -1, 60, True)
    else:
        _paint_disc(canvas, centre, 34 if kind < 0.5 else 26, True)


def _paint_disc(canvas: np.ndarray, centre: tuple[int, int], radius: int, value: bool) -> None:
    rows, columns, inside = _disc(centre, radius)
    place = np.ix_(rows, columns)
    canvas[place] = np.where(inside, value, canvas[place])


def _disc(centre: tuple[int, int], radius: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows, columns and mask of a disc that goes on across the borders; lengths in sixteenths of a pixel."""
    (columns, dx), (rows, dy) = (
        (span % _PAISLEY_PX, span * 16 + 8 - c)
        for c in centre
        for span in (np.arange((c - radius) // 16, (c + radius) // 16 + 1),)
    )
    return rows, columns, dx[None, :] ** 2 + dy[:, None] ** 2 <= radius * radius
