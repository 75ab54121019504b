"""An asset pack with random shapes and textures, whose names contain their seeds.

Textures are stripes, dots, checks, patches, swirls and plain colours: two or three colours from anywhere, any
scale, any angle. They know nothing of the catalogue, so what is learnt from them is what textures are like.
"""

import colorsys
import re
from functools import lru_cache

import numpy as np

from openvima.catalog.geometry import Assets, Geometry, Vector3, protect
from openvima.catalog.meshes import scale_geometry
from openvima.catalog.objects import NO_SYMMETRY, object_spec
from openvima.catalog.random_shapes import RANDOM_SHAPES, has_heading, random_outline
from openvima.catalog.textures import DARK_VALUE_DROP

_SIDE_PX = 128
_PLACES = (np.arange(_SIDE_PX) + 0.5) / _SIDE_PX - 0.5  # of pixels about the middle of the image


def hash_numbers(rows: np.ndarray, columns: np.ndarray, seed: int) -> np.ndarray:
    """Return a number in [0, 1) for each pair of whole numbers.

    Args:
        rows: Non-negative integers.
        columns: The same, broadcast against them.
        seed: Seed of the hash.

    Returns:
        float64, multiples of 2⁻³².

    Source: the mixing steps of SplitMix64 (Steele, Lea and Flood, 2014).
    """
    state = np.asarray(seed, dtype=np.uint64)
    with np.errstate(over="ignore"):  # overflow is intended
        for coordinate in (rows, columns):
            state = _mix_bits(state * np.uint64(31) + coordinate.astype(np.uint64) + np.uint64(1))
    return (state >> np.uint64(32)).astype(np.float64) / 2.0**32


def _mix_bits(state: np.ndarray) -> np.ndarray:
    state = state * np.uint64(0x9E3779B97F4A7C15)
    state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return state ^ (state >> np.uint64(31))


def value_noise(cells: tuple[int, int], seed: int) -> np.ndarray:
    """Return smooth noise in [0, 1) that continues across opposite borders, shape (128, 128).

    Args:
        cells: Number of random values down and across, between which the noise changes smoothly.
        seed: Seed of the noise.
    """
    rows, columns = (np.arange(_SIDE_PX) * count / _SIDE_PX for count in cells)
    top, left = rows.astype(np.int64), columns.astype(np.int64)
    down, right = _smooth(rows - top)[:, None], _smooth(columns - left)[None, :]
    lattice = hash_numbers(*np.ogrid[: cells[0], : cells[1]], seed=seed)

    def across(row: np.ndarray) -> np.ndarray:
        return lattice[row][:, left] * (1 - right) + lattice[row][:, (left + 1) % cells[1]] * right

    return across(top) * (1 - down) + across((top + 1) % cells[0]) * down


def layered_noise(cells: tuple[int, int], seed: int, num_layers: int) -> np.ndarray:
    """Return fractal noise in [0, 1): layers of doubled frequency and halved amplitude."""
    layers = (0.5**k * value_noise((cells[0] << k, cells[1] << k), seed + k) for k in range(num_layers))
    return sum(layers, np.zeros((_SIDE_PX, _SIDE_PX))) / (2 - 0.5 ** (num_layers - 1))  # the sum of weights


def _smooth(t: np.ndarray) -> np.ndarray:
    return t * t * (3 - 2 * t)


_PERIODS = (0.05, 0.35)  # shortest and longest, in widths of the image; a kit object shows a third of it
_LEAST_CONTRAST = 60  # in the channel in which two neighbouring colours differ most
_GREY_SHARE = 0.2
_PLAIN_SHARE = 0.2

_Field = np.ndarray  # shape (S, S): what decides which colour a pixel has, a whole colour for each step of 1


def random_texture(rng: np.random.Generator) -> np.ndarray:
    """Draw a texture.

    Args:
        rng: Every draw comes from here.

    Returns:
        Shape (128, 128, 3), uint8, row 0 on top; 1 × 1 for plain colours.
    """
    if rng.random() < _PLAIN_SHARE:
        return _random_colour(rng).astype(np.uint8).reshape(1, 1, 3)
    colours = _contrasting_colours(rng, count=int(rng.integers(2, 4)))
    field = _FAMILIES[int(rng.integers(len(_FAMILIES)))](rng)
    image = _blend(field, colours) if rng.random() < 0.25 else colours[field.astype(np.int64) % len(colours)]
    if rng.random() < 0.3:
        grain = value_noise((64, 64), _seed(rng)) - 0.5
        image = image + rng.uniform(5, 25) * grain[..., None]
    return np.clip(image, 0, 255).astype(np.uint8)


def darken_texture(texture: np.ndarray) -> np.ndarray:
    """Lower the HSV value of each pixel by 0.3, not below 0, as the dark textures of the catalogue are made.

    Args:
        texture: Shape (H, W, 3), uint8.
    """
    value = texture.max(axis=2, keepdims=True) / 255
    factor = np.maximum(0, value - DARK_VALUE_DROP) / np.maximum(value, 1 / 255)
    return (texture * factor).astype(np.uint8)


def _random_colour(rng: np.random.Generator) -> np.ndarray:
    """Any hue; shape (3,), float64, 0 to 255."""
    saturation = 0.0 if rng.random() < _GREY_SHARE else rng.uniform(0.15, 1.0)
    return 255 * np.array(colorsys.hsv_to_rgb(rng.random(), saturation, rng.uniform(0.2, 1.0)))


def _contrasting_colours(rng: np.random.Generator, *, count: int) -> np.ndarray:
    """Colours of which no two are alike, shape (count, 3), float64."""
    colours = [_random_colour(rng)]
    while len(colours) < count:
        colour = _random_colour(rng)
        if min(np.abs(colour - other).max() for other in colours) >= _LEAST_CONTRAST:
            colours.append(colour)
    return np.array(colours)


def _blend(field: _Field, colours: np.ndarray) -> np.ndarray:
    """Go from colour to colour without a border, shape (S, S, 3)."""
    first = np.floor(field).astype(np.int64)
    weight = (field - first)[..., None]
    return colours[first % len(colours)] * (1 - weight) + colours[(first + 1) % len(colours)] * weight


def _axes(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates along and across a random direction, in random periods, about the middle of the image."""
    x, y = np.meshgrid(_PLACES, _PLACES)
    angle, period = rng.uniform(0, 2 * np.pi), float(np.exp(rng.uniform(*np.log(_PERIODS))))
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    return along / period + rng.uniform(0, 8), across / (period * rng.uniform(0.6, 1.7)) + rng.uniform(0, 8)


def _stripes(rng: np.random.Generator) -> _Field:
    along, _ = _axes(rng)
    return 2 * along


def _waves(rng: np.random.Generator) -> _Field:
    along, across = _axes(rng)
    return 2 * along + rng.uniform(0.3, 1.5) * np.sin(rng.uniform(1, 4) * across)


def _checks(rng: np.random.Generator) -> _Field:
    along, across = _axes(rng)
    return np.floor(2 * along) + np.floor(2 * across)


def _dots(rng: np.random.Generator) -> _Field:
    along, across = _axes(rng)
    shift = rng.choice((0.0, 0.5))
    row = np.floor(across)
    dx, dy = (along + shift * row) % 1 - 0.5, across - row - 0.5
    size, squareness = rng.uniform(0.18, 0.45), rng.choice((1.0, 2.0, 6.0))  # diamonds, discs, squares
    inside = np.abs(dx) ** squareness + np.abs(dy) ** squareness < size**squareness
    return np.where(inside, 1.0 + (row % 2 if rng.random() < 0.3 else 0.0), 0.0)


def _bricks(rng: np.random.Generator) -> _Field:
    along, across = _axes(rng)
    row = np.floor(across)
    joint = rng.uniform(0.08, 0.25)
    x = along / rng.uniform(1.0, 2.5) + 0.5 * row
    return np.where((x % 1 < joint) | (across % 1 < joint), 0.0, 1.0 + (np.floor(x) + row) % 2)


def _patches(rng: np.random.Generator) -> _Field:
    cells = (int(rng.integers(3, 20)), int(rng.integers(3, 20)))
    noise = layered_noise(cells, _seed(rng), num_layers=int(rng.integers(1, 4)))
    return rng.uniform(2, 5) * noise + rng.uniform(0, 3)


def _veins(rng: np.random.Generator) -> _Field:
    cells = (int(rng.integers(3, 12)), int(rng.integers(3, 12)))
    noise = layered_noise(cells, _seed(rng), num_layers=3)
    return np.where(np.abs(noise - 0.5) < rng.uniform(0.02, 0.07), 1.0, 0.0)


def _swirl(rng: np.random.Generator) -> _Field:
    """Rays about a point near the middle, bent into a spiral; without rays these are circles."""
    x, y = np.meshgrid(_PLACES - rng.uniform(-0.15, 0.15), _PLACES - rng.uniform(-0.15, 0.15))
    num_rays = int(rng.choice((0, 1, 2, 3, 5, 8, 12)))
    bend = rng.uniform(8, 30) if num_rays < 2 else rng.uniform(-12, 12)
    return 6 + num_rays * np.arctan2(y, x) / np.pi + bend * np.sqrt(x * x + y * y)


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 31))


_FAMILIES = (_stripes, _waves, _checks, _dots, _bricks, _patches, _veins, _swirl)


_NAME = re.compile(rf"(dark )?random (texture|{'|'.join(RANDOM_SHAPES)}) (\d+)")
_NUM_SEEDS = 1 << 31
_KEPT = 64  # cached shapes and textures: those of a few scenes


class RandomAppearanceAssets:
    """A pack that adds "random texture 7", "dark random texture 7", "random shape 7" and so on to another.

    Random shapes are for images only: they have no collision, and no task uses them.

    Args:
        base: Pack of the catalogue's shapes and textures.
        num_kept: Random shapes and textures to cache, of each kind; 30 and 50 kB each.
    """

    def __init__(self, base: Assets, num_kept: int = _KEPT) -> None:
        self.base, self.name = base, f"{base.name} and random appearance"
        self._plain_shape = lru_cache(num_kept)(_draw_shape)
        self._shape = lru_cache(_KEPT)(self._stretch)
        self._texture = lru_cache(num_kept)(_draw_texture)

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        """Return a shape; see `Assets.geometry`. Random shapes have one size and ignore `size`."""
        if is_random(object_name):
            return self._shape(object_name, scale)
        return self.base.geometry(object_name, size, scale)

    def texture(self, texture_name: str) -> np.ndarray:
        """Return a texture's image; see `Assets.texture`."""
        return self._texture(texture_name) if is_random(texture_name) else self.base.texture(texture_name)

    def _stretch(self, name: str, scale: Vector3) -> Geometry:
        return protect(scale_geometry(self._plain_shape(name), scale))


def random_name(kind: str, rng: np.random.Generator, pool: range = range(_NUM_SEEDS)) -> str:
    """Draw the name of a "texture", or of a kind of shape, such as "shape", "container" or "grating".

    Args:
        kind: The kind.
        rng: Generator of the draw.
        pool: Seeds to draw from; a few of them can be cached.
    """
    return f"random {kind} {int(rng.integers(pool.start, pool.stop))}"


def is_random(name: str) -> bool:
    """Whether a name is that of a random shape or texture."""
    return _NAME.fullmatch(name) is not None


@lru_cache(4096)
def has_visible_heading(object_name: str) -> bool:
    """Whether the yaw of a shape is visible: it has no rotational symmetry."""
    if not is_random(object_name):
        return object_spec(object_name).symmetry_rad == NO_SYMMETRY
    kind, rng = _read(object_name)
    return kind == "shape" and has_heading(random_outline(rng))


def _read(name: str) -> tuple[str, np.random.Generator]:
    match = _NAME.fullmatch(name)
    assert match is not None, name
    return match[2], np.random.default_rng(int(match[3]))


def _draw_shape(name: str) -> Geometry:
    kind, rng = _read(name)
    return protect(RANDOM_SHAPES[kind](rng))


def _draw_texture(name: str) -> np.ndarray:
    _, rng = _read(name)
    image = random_texture(rng)
    image = darken_texture(image) if name.startswith("dark ") else image
    image.setflags(write=False)
    return image
