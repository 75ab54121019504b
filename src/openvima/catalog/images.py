"""Images of the procedural textures."""

from collections.abc import Callable

import numpy as np

from openvima.catalog import materials, patterns
from openvima.catalog.patterns import Colour
from openvima.catalog.textures import TextureSpec, texture_spec

_SPECIALS: dict[str, Callable[[], np.ndarray]] = {
    "brick": materials.brick,
    "tiles": materials.tiles,
    "wooden": materials.wooden,
    "granite": materials.granite,
    "plastic": materials.plastic,
    "polka dot": lambda: patterns.polka_dot(patterns.BLACK, patterns.WHITE),
    "checkerboard": patterns.checkerboard,
    "tiger": materials.tiger,
    "magma": materials.magma,
    "rainbow": patterns.rainbow,
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
        return patterns.stripe(*colours)
    if spec.category == "polka_dot_2":
        return patterns.polka_dot(*colours)
    if spec.category == "swirl":
        return patterns.swirl(*colours)
    return patterns.paisley(*colours)


def _base_colour(spec: TextureSpec, name: str) -> Colour:
    """A colour of a pattern; that of a dark pattern is the dark plain colour."""
    texel = texture_spec(f"dark {name}" if spec.is_dark else name).texel
    assert texel is not None, f"{name} is a plain colour"
    return texel
