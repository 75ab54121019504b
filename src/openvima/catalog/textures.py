"""The 82 textures of the benchmark, 49 light and 33 dark, and the neutral gray of some prompt images.

Source: the texture list and base colours of VIMA-Bench. A dark colour is the light one with its HSV value
lowered by 0.3.
"""

import colorsys
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

from openvima.errors import UnknownNameError, unknown_name

TextureCategory = Literal[
    "plain", "special", "stripe", "polka_dot_2", "swirl", "paisley", "neutral", "registered"
]
Rgb = tuple[float, float, float]

NEUTRAL_TEXTURE = "gray"
DARK_VALUE_DROP = 0.3  # of the HSV value, whose range is [0, 1]

BASE_COLOURS: dict[str, tuple[int, int, int]] = {
    "blue": (78, 121, 167),
    "red": (255, 87, 89),
    "green": (89, 169, 79),
    "orange": (242, 142, 43),
    "yellow": (237, 201, 72),
    "purple": (176, 122, 161),
    "pink": (255, 157, 167),
    "cyan": (118, 183, 178),
    "olive": (128, 128, 0),
}
"""Plain colours as 8-bit RGB; patterns are made of them."""

NEUTRAL_COLOUR = (186, 176, 172)
SPECIAL_NAMES = (
    *("brick", "tiles", "wooden", "granite", "plastic", "polka dot", "checkerboard", "tiger", "magma"),
    "rainbow",
)
COLOUR_PAIRS = tuple(combinations(("red", "yellow", "green", "blue", "purple"), 2))
PATTERN_COLOURS = ("red", "yellow", "green", "blue", "purple")
_WITHOUT_DARK_VARIANT = ("olive",)


@dataclass(frozen=True, slots=True)
class TextureSpec:
    """What the catalogue knows about one texture.

    Args:
        name: Display name, such as "dark red and yellow stripe".
        id: Identifier in upper case.
        category: Family of patterns that it belongs to; "neutral" for gray, "registered" for a user's.
        is_dark: Whether it is the dark variant of another one.
        colour: RGB in [0, 1] of a plain colour, unrounded; None for a pattern.
        base_colours: Names of the colours of a pattern: first and second stripe, dots and ground, or the one
            colour beside white. Empty for plain and special textures.
        dark_variant: Name of the dark variant, if there is one.
    """

    name: str
    id: str
    category: TextureCategory
    is_dark: bool = False
    colour: Rgb | None = None
    base_colours: tuple[str, ...] = ()
    dark_variant: str | None = None

    @property
    def light_variant(self) -> str:
        """Name of the texture that this one is the dark variant of, or its own."""
        return self.name.removeprefix("dark ") if self.is_dark else self.name

    @property
    def texel(self) -> tuple[int, int, int] | None:
        """The 8-bit colour of a plain texture, rounded down; None for a pattern."""
        if self.colour is None:
            return None
        # 1e-9: a product such as 255 * (178 / 255) may end just below the whole number that it stands for
        red, green, blue = (int(255 * channel + 1e-9) for channel in self.colour)
        return (red, green, blue)


def darkened(colour: Rgb) -> Rgb:
    """Lower the HSV value of an RGB colour in [0, 1] by 0.3, not below 0."""
    hue, saturation, value = colorsys.rgb_to_hsv(*colour)
    return colorsys.hsv_to_rgb(hue, saturation, max(0.0, value - DARK_VALUE_DROP))


def _unit_rgb(colour: tuple[int, int, int]) -> Rgb:
    red, green, blue = colour
    return (red / 255, green / 255, blue / 255)


def _identifier(name: str) -> str:
    return name.upper().replace(" ", "_")


def _light_and_dark(
    name: str, category: TextureCategory, base_colours: tuple[str, ...]
) -> tuple[TextureSpec, ...]:
    """A pattern and, except for paisleys, its dark variant."""
    if category == "paisley":
        return (TextureSpec(name, _identifier(name), category, base_colours=base_colours),)
    dark = f"dark {name}"
    return (
        TextureSpec(name, _identifier(name), category, base_colours=base_colours, dark_variant=dark),
        TextureSpec(dark, _identifier(dark), category, is_dark=True, base_colours=base_colours),
    )


def _patterns() -> list[TextureSpec]:
    specs = [TextureSpec(name, _identifier(name), "special") for name in SPECIAL_NAMES]
    for pair in COLOUR_PAIRS:
        specs += _light_and_dark(f"{pair[0]} and {pair[1]} stripe", "stripe", pair)
    for pair in COLOUR_PAIRS:
        specs += _light_and_dark(f"{pair[0]} and {pair[1]} polka dot", "polka_dot_2", pair)
    for colour in PATTERN_COLOURS:
        specs += _light_and_dark(f"{colour} swirl", "swirl", (colour,))
    for colour in PATTERN_COLOURS:
        specs += _light_and_dark(f"{colour} paisley", "paisley", (colour,))
    return specs


def _plain_colours() -> list[TextureSpec]:
    light, dark = [], []
    for name, rgb in BASE_COLOURS.items():
        colour = _unit_rgb(rgb)
        dark_name = None if name in _WITHOUT_DARK_VARIANT else f"dark {name}"
        light.append(TextureSpec(name, _identifier(name), "plain", colour=colour, dark_variant=dark_name))
        if dark_name:
            dark_id = _identifier(dark_name)
            dark.append(TextureSpec(dark_name, dark_id, "plain", is_dark=True, colour=darkened(colour)))
    return light + dark


TEXTURES: dict[str, TextureSpec] = {spec.name: spec for spec in (*_patterns(), *_plain_colours())}
"""The 82 textures by display name: patterns, each light one followed by its dark one, then plain colours."""

REGISTERED_TEXTURES: dict[str, TextureSpec] = {}
"""Textures of users by display name, from `register_texture`."""

_NEUTRAL = TextureSpec(NEUTRAL_TEXTURE, "GRAY", "neutral", colour=_unit_rgb(NEUTRAL_COLOUR))


def texture_spec(name: str) -> TextureSpec:
    """Return the record of a texture.

    Args:
        name: Display name, case-sensitive, such as "red swirl"; "gray" is the neutral colour of some prompt
            images and no member of `TEXTURES`.

    Raises:
        UnknownNameError: There is no such texture; the message suggests the nearest name.

    Example:
        >>> texture_spec("dark blue").texel
        (42, 65, 90)
    """
    if name == NEUTRAL_TEXTURE:
        return _NEUTRAL
    try:
        return TEXTURES.get(name) or REGISTERED_TEXTURES[name]
    except (KeyError, TypeError):
        hint = (
            "`openvima.catalog.TEXTURES` holds the 82 built-in ones; your own need `register_texture`, in "
            "a file of OPENVIMA_TASK_FILES or for --assets."
        )
        known = (*TEXTURES, *REGISTERED_TEXTURES)
        raise UnknownNameError(unknown_name("texture", name, known, hint)) from None
