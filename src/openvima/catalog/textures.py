"""The 82 textures of the benchmark, 49 light and 33 dark, and the neutral gray of some prompts.

They are read from `textures.json`. Source: the texture list and base colours of VIMA-Bench. A dark
colour is the light one with its HSV value lowered by 0.3.
"""

from dataclasses import dataclass
from pathlib import Path

from openvima.catalog.records import find_record, read_records

Rgb = tuple[float, float, float]

NEUTRAL_TEXTURE = "gray"
DARK_VALUE_DROP = 0.3  # of the HSV value, whose range is [0, 1]


@dataclass(frozen=True, slots=True)
class TextureSpec:
    """What the catalogue knows about one texture.

    Args:
        name: Display name, such as "dark red and yellow stripe".
        category: Family of patterns that it belongs to: "plain", "special", "stripe", "polka_dot_2", "swirl"
            or "paisley"; "neutral" for gray, "registered" for a user's.
        is_dark: Whether it is the dark variant of another one.
        colour: RGB in [0, 1] of a plain colour, unrounded; None for a pattern.
        base_colours: Names of the colours of a pattern: first and second stripe, dots and ground, or the one
            colour beside white. Empty for plain and special textures.
        dark_variant: Name of the dark variant, if there is one.
        original_file: Where the original pack keeps the image; empty for plain colours.
    """

    name: str
    category: str
    is_dark: bool = False
    colour: Rgb | None = None
    base_colours: tuple[str, ...] = ()
    dark_variant: str | None = None
    original_file: str = ""

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


TEXTURES: dict[str, TextureSpec] = {
    record["name"]: TextureSpec(**record) for record in read_records(Path(__file__).with_suffix(".json"))
}
"""The 82 textures by display name: patterns, each light one followed by its dark one, then plain colours."""

REGISTERED_TEXTURES: dict[str, TextureSpec] = {}
"""Textures of users by display name, from `register_texture`."""

_NEUTRAL = TEXTURES.pop(NEUTRAL_TEXTURE)
BASE_COLOURS: dict[str, tuple[int, ...]] = {
    name: tuple(round(255 * part) for part in spec.colour)
    for name, spec in TEXTURES.items()
    if spec.colour and not spec.is_dark
}
"""Plain colours as 8-bit RGB; patterns are made of them."""


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
    return find_record("texture", name, TEXTURES, REGISTERED_TEXTURES)
