"""Textures of materials: brick, tiles, wood, granite, plastic, tiger fur and magma."""

import numpy as np

from openvima.catalog.noise import hashed, layered_noise, value_noise

_SIDE_PX = 256


def brick() -> np.ndarray:
    """Eighteen courses of seven salmon bricks in running bond, with beige mortar."""
    course_px, brick_px, mortar_px = 14, 36, 2
    row, column = np.indices((18 * course_px, 7 * brick_px))
    course = row // course_px
    along = (column + course % 2 * (brick_px // 2)) % (7 * brick_px)
    mortar = (row % course_px < mortar_px) | (along % brick_px < mortar_px)
    shade = hashed(course, along // brick_px, seed=11)
    bricks = _blend((190, 121, 103), (174, 106, 88), shade)
    grain = 14 * hashed(row, column, seed=12) - 7
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
    colour = palette[(3 * hashed(band, tile, seed=21)).astype(np.int64)]
    tone = 20 * hashed(band, tile, seed=22) - 10 + 8 * hashed(row, column, seed=23) - 4
    return _to_image(np.where(inside[..., None], colour + tone[..., None], (72, 67, 61)))


def wooden() -> np.ndarray:
    """A parquet of narrow vertical strips in tans, with staggered joints and fine grain."""
    strip_px, board_px = 8, 128
    row, column = np.indices((_SIDE_PX, _SIDE_PX))
    strip = column // strip_px
    offset = (board_px * hashed(strip, seed=31)).astype(np.int64)
    board = (row + offset) // board_px
    tone = _blend((203, 155, 103), (231, 194, 150), hashed(strip, board, seed=32))
    fibres = hashed(column, board, seed=33) + value_noise((_SIDE_PX, _SIDE_PX), (8, 128), seed=34) - 1
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
    return _to_image(stone + 12 * hashed(*np.indices(shape), seed=44)[..., None] - 6)


def plastic() -> np.ndarray:
    """Light grey film, crumpled: faint facets with short bright and dark creases in all directions."""
    row, column = np.indices((_SIDE_PX, _SIDE_PX))
    x, y = column / _SIDE_PX, row / _SIDE_PX
    tone = np.zeros((_SIDE_PX, _SIDE_PX))
    for i in range(90):
        px, py, dx, dy, length = (float(hashed(i, k, seed=51)) for k in range(5))
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
