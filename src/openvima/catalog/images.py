"""Images of the procedural textures: patterns, materials, and the noise that they are made of.

Layouts of the patterns follow those of the original images at a fraction of their size. Noise comes from
integer hashing, and pixels from whole numbers wherever it is easy, else from comparisons far from a tie, so
that images are bit-identical on every machine and with every NumPy version.
"""

import math
from collections.abc import Callable

import numpy as np

from openvima.catalog.textures import TextureSpec, texture_spec


def hash_numbers(*coordinates: np.ndarray | int, seed: int) -> np.ndarray:
    """Return a number in [0, 1) for each combination of whole numbers.

    Args:
        *coordinates: Arrays of non-negative integers, broadcast against each other.
        seed: Seed of the hash.

    Returns:
        float64, multiples of 2⁻³².

    Source: the mixing steps of SplitMix64 (Steele, Lea and Flood, 2014).
    """
    state = np.asarray(seed, dtype=np.uint64)
    with np.errstate(over="ignore"):  # overflow is intended
        for coordinate in coordinates:
            state = _mix_bits(state * np.uint64(31) + np.asarray(coordinate).astype(np.uint64) + np.uint64(1))
    return (state >> np.uint64(32)).astype(np.float64) / 2.0**32


def _mix_bits(state: np.ndarray) -> np.ndarray:
    state = state * np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


def value_noise(shape: tuple[int, int], cells: tuple[int, int], seed: int) -> np.ndarray:
    """Return smooth noise in [0, 1) that continues across opposite borders.

    Args:
        shape: Rows and columns of the image.
        cells: Number of random values down and across, between which the noise changes smoothly.
        seed: Seed of the noise.
    """
    rows, columns = (np.arange(n) * c / n for n, c in zip(shape, cells, strict=True))
    top, left = rows.astype(np.int64), columns.astype(np.int64)
    down, right = _smooth(rows - top)[:, None], _smooth(columns - left)[None, :]

    def lattice(row_shift: int, column_shift: int) -> np.ndarray:
        row, column = (top + row_shift) % cells[0], (left + column_shift) % cells[1]
        return hash_numbers(row[:, None], column[None, :], seed=seed)

    above = lattice(0, 0) * (1 - right) + lattice(0, 1) * right
    below = lattice(1, 0) * (1 - right) + lattice(1, 1) * right
    return above * (1 - down) + below * down


def layered_noise(shape: tuple[int, int], cells: tuple[int, int], seed: int, num_layers: int) -> np.ndarray:
    """Return fractal noise in [0, 1): layers of doubled frequency and halved amplitude."""
    total, weight_sum = np.zeros(shape), 0.0
    for layer in range(num_layers):
        weight = 0.5**layer
        total += weight * value_noise(shape, (cells[0] << layer, cells[1] << layer), seed + layer)
        weight_sum += weight
    return total / weight_sum


def _smooth(t: np.ndarray) -> np.ndarray:
    return t * t * (3 - 2 * t)


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
    change = np.where(veins < 0.02, -16, 0) + (12 * hash_numbers(row, column, seed=72)).astype(np.int64) - 5
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
    dice = [float(hash_numbers(index, k, seed=80)) for k in range(5)]
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
    x, y, kind, turn = (float(hash_numbers(index, k, seed=81)) for k in range(4))
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


_SIDE_PX = 256


def brick() -> np.ndarray:
    """Eighteen courses of seven salmon bricks in running bond, with beige mortar."""
    course_px, brick_px, mortar_px = 14, 36, 2
    row, column = np.indices((18 * course_px, 7 * brick_px))
    course = row // course_px
    along = (column + course % 2 * (brick_px // 2)) % (7 * brick_px)
    mortar = (row % course_px < mortar_px) | (along % brick_px < mortar_px)
    shade = hash_numbers(course, along // brick_px, seed=11)
    bricks = _blend((190, 121, 103), (174, 106, 88), shade)
    grain = 14 * hash_numbers(row, column, seed=12) - 7
    return _to_image(np.where(mortar[..., None], (187, 152, 135), bricks) + grain[..., None])


def tiles() -> np.ndarray:
    """Round tiles in three pale colours, packed in sixteen rows of fourteen on dark grout."""
    pitch, row_px, radius = 18, 16, 8.35
    height, width = 16 * row_px, 14 * pitch
    row, column = np.indices((height, width))
    band = row // row_px
    along = (column + band % 2 * (pitch // 2)) % width
    tile = along // pitch
    dx, dy = along % pitch + 0.5 - pitch / 2, row % row_px + 0.5 - row_px / 2
    # A disc that is taller than its row is cut off at the border, as tiles that touch are.
    inside = dx * dx + dy * dy < radius * radius
    palette = np.array([(174, 183, 172), (125, 142, 150), (165, 138, 130)])
    colour = palette[(3 * hash_numbers(band, tile, seed=21)).astype(np.int64)]
    tone = 20 * hash_numbers(band, tile, seed=22) - 10 + 8 * hash_numbers(row, column, seed=23) - 4
    return _to_image(np.where(inside[..., None], colour + tone[..., None], (72, 67, 61)))


def wooden() -> np.ndarray:
    """A parquet of narrow vertical strips in tans, with staggered joints and fine grain."""
    strip_px, board_px = 8, 128
    row, column = np.indices((_SIDE_PX, _SIDE_PX))
    strip = column // strip_px
    offset = (board_px * hash_numbers(strip, seed=31)).astype(np.int64)
    board = (row + offset) // board_px
    tone = _blend((203, 155, 103), (231, 194, 150), hash_numbers(strip, board, seed=32))
    fibres = hash_numbers(column, board, seed=33) + value_noise((_SIDE_PX, _SIDE_PX), (8, 128), seed=34) - 1
    joint = (column % strip_px == 0) | ((row + offset) % board_px < 1)
    return _to_image(tone + 14 * fibres[..., None] - np.where(joint, 16, 0)[..., None])


def granite() -> np.ndarray:
    """Pale grey-green stone, softly mottled, with irregular specks that gather in clouds."""
    shape = (_SIDE_PX, _SIDE_PX)
    cloud = layered_noise(shape, (5, 5), seed=45, num_layers=2) - 0.5
    mottle = layered_noise(shape, (20, 24), seed=41, num_layers=3) - 0.5
    stone = np.array((200.0, 213.0, 207.0)) + 40 * mottle[..., None] + 22 * cloud[..., None]
    # Colour, cells of the noise, the value from which it shows, and over how much of it that fades in.
    for seed, colour, cells, start, fade, strength in (
        (47, (150, 165, 168), (26, 30), 0.60, 0.16, 0.9),
        (42, (124, 136, 143), (58, 50), 0.60, 0.14, 0.9),
        (43, (58, 54, 72), (72, 60), 0.70, 0.12, 1.0),
    ):
        specks = layered_noise(shape, cells, seed=seed, num_layers=2) + 0.25 * cloud
        weight = strength * np.clip((specks - start) / fade, 0, 1)
        stone += (np.array(colour, dtype=np.float64) - stone) * weight[..., None]
    return _to_image(stone + 12 * hash_numbers(*np.indices(shape), seed=44)[..., None] - 6)


def plastic() -> np.ndarray:
    """Light grey film, crumpled: faint facets with short bright and dark creases in all directions."""
    row, column = np.indices((_SIDE_PX, _SIDE_PX))
    x, y = column / _SIDE_PX, row / _SIDE_PX
    tone = np.zeros((_SIDE_PX, _SIDE_PX))
    for i in range(90):
        px, py, dx, dy, length = (float(hash_numbers(i, k, seed=51)) for k in range(5))
        dx, dy = dx - 0.5, dy - 0.5
        norm = max(abs(dx), abs(dy), 0.05)
        along = ((x - px) * dx + (y - py) * dy) / norm
        across = ((x - px) * dy - (y - py) * dx) / norm
        reach = 0.05 + 0.13 * length
        near = 1 - np.abs(along) / reach  # the crease ends in a point
        tone += np.where((near > 0) & (across > 0) & (across < 0.05), 3.0 if i % 3 else -4.0, 0.0)
        tone += np.where((near > 0) & (np.abs(across) < 0.011 * near), 19.0 if i % 3 else -16.0, 0.0)
    return _to_image(np.array((221.8, 220.3, 219.8)) + np.clip(tone, -30, 30)[..., None])


def tiger() -> np.ndarray:
    """Orange fur with about twelve black, wavy, forking, roughly vertical stripes."""
    shape = (_SIDE_PX, _SIDE_PX)
    column = np.arange(_SIDE_PX)[None, :] / _SIDE_PX
    wave = layered_noise(shape, (5, 3), seed=61, num_layers=3)
    phase = (12 * column + 3.4 * wave) % 1.0
    ridge = 2 * np.abs(phase - 0.5)  # 1 in the middle of a stripe, 0 between two
    width = 0.06 + 0.60 * layered_noise(shape, (9, 6), seed=62, num_layers=2)
    black = ridge > 1 - width
    fur = _blend((205, 124, 22), (236, 172, 46), layered_noise(shape, (6, 6), seed=63, num_layers=2))
    hair = 22 * value_noise(shape, (24, 128), seed=64) - 11
    return _to_image(np.where(black[..., None], (9, 4, 4), fur + hair[..., None]))


def magma() -> np.ndarray:
    """Black crust broken by a net of thin glowing veins in a dark red haze."""
    shape = (_SIDE_PX, _SIDE_PX)
    # Veins run where a noise crosses its middle value; where it is steep they are thin.
    wide = np.abs(layered_noise(shape, (7, 7), seed=66, num_layers=3) - 0.5)
    fine = np.abs(layered_noise(shape, (12, 12), seed=67, num_layers=2) - 0.5)
    distance = np.minimum(wide, 0.014 + 0.7 * fine)
    colours = np.array([(240, 110, 32), (186, 66, 16), (70, 13, 4), (8, 1, 1)], dtype=np.float64)
    places = (0.0, 0.016, 0.045, 0.085)
    channels = [np.interp(distance, places, colours[:, c]) for c in range(3)]
    return _to_image(np.stack(channels, axis=-1))


def _blend(first: tuple[int, int, int], second: tuple[int, int, int], weight: np.ndarray) -> np.ndarray:
    """Mix two colours; a weight of 1 gives the second."""
    start, end = np.array(first, dtype=np.float64), np.array(second, dtype=np.float64)
    return start + (end - start) * weight[..., None]


def _to_image(colours: np.ndarray) -> np.ndarray:
    # The small offset keeps whole numbers that arithmetic missed by a rounding error on their side.
    return np.clip(np.floor(colours + 1e-6), 0, 255).astype(np.uint8)


_SPECIALS: dict[str, Callable[[], np.ndarray]] = {
    "brick": brick,
    "tiles": tiles,
    "wooden": wooden,
    "granite": granite,
    "plastic": plastic,
    "polka dot": lambda: polka_dot(BLACK, WHITE),
    "checkerboard": checkerboard,
    "tiger": tiger,
    "magma": magma,
    "rainbow": rainbow,
}


def draw_texture(texture_name: str) -> np.ndarray:
    """Draw a texture.

    Args:
        texture_name: Display name.

    Returns:
        Shape (H, W, 3), uint8, row 0 on top; 1 × 1 for plain colours.

    Raises:
        UnknownTextureError: The catalogue has no such texture.
    """
    spec = texture_spec(texture_name)
    if spec.texel is not None:
        return np.array(spec.texel, dtype=np.uint8).reshape(1, 1, 3)
    if spec.category == "special":
        return _SPECIALS[texture_name]()
    colours = [_base_colour(spec, name) for name in spec.base_colours]
    if spec.category == "stripe":
        return stripe(*colours)
    if spec.category == "polka_dot_2":
        return polka_dot(*colours)
    if spec.category == "swirl":
        return swirl(*colours)
    return paisley(*colours)


def _base_colour(spec: TextureSpec, name: str) -> Colour:
    """A colour of a pattern; that of a dark pattern is the dark plain colour."""
    texel = texture_spec(f"dark {name}" if spec.is_dark else name).texel
    assert texel is not None, f"{name} is a plain colour"
    return texel
