"""Multimodal prompts as images for people: words and thumbnails in reading order."""

import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from openvima.render import channels_last
from openvima.scene import BACKGROUND_ID, PromptImage, RenderedPrompt

Colour = tuple[int, int, int]

INK: Colour = (28, 32, 38)
PAPER: Colour = (255, 255, 255)
EDGE: Colour = (208, 213, 220)
MUTED: Colour = (91, 100, 114)
_CLOSING = ".,;:!?)"  # no space before these
_ROW_HEIGHT = 18  # pixels of a row of attention


class _Piece(NamedTuple):
    """A word or a thumbnail, with its size and the space before it, in pixels."""

    content: str | Image.Image
    width: int
    height: int
    space: int


def prompt_pieces(prompt: RenderedPrompt) -> "list[str | PromptImage]":
    """Split a prompt into single words and images, in reading order."""
    pieces: list[str | PromptImage] = []
    for part in prompt.sequence():
        pieces += part.split() if isinstance(part, str) else [part]
    return pieces


def thumbnail(image: PromptImage, height: int = 72) -> Image.Image:
    """Draw the front view of a prompt image as a thumbnail.

    Images of single objects are cropped to the object; scenes stay whole.

    Args:
        image: Rendered image of one placeholder.
        height: Height of the thumbnail in pixels.

    Returns:
        RGB image of that height, with a thin frame.
    """
    pixels = np.ascontiguousarray(channels_last(image.rgb["front"]))
    if image.kind == "object":
        pixels = cut_to_object(pixels, image.segm["front"])
    rows, columns = pixels.shape[:2]
    width = max(1, round(columns * height / rows))
    picture = Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX)
    ImageDraw.Draw(picture).rectangle((0, 0, width - 1, height - 1), outline=EDGE)
    return picture


def draw_prompt_strip(
    prompt: RenderedPrompt,
    *,
    width: int,
    image_height: int = 64,
    font_size: int = 22,
    weights: Sequence[tuple[Colour, np.ndarray]] = (),
) -> np.ndarray:
    """Draw a prompt as a strip of words and thumbnails, wrapped to a width.

    Args:
        prompt: The prompt as a policy receives it.
        width: Width of the strip in pixels.
        image_height: Height of the thumbnails in pixels.
        font_size: Font size in pixels.
        weights: Attention to draw below the words and images, one row each: its colour, and a weight from 0
            to 1 for each piece; one more weight stands for the end of the prompt.

    Returns:
        Shape (height, `width`, 3), uint8; the height is even and follows from the number of lines.
    """
    margin = max(6, font_size // 2)
    typeface = font(font_size)
    pieces = [_piece(part, image_height, font_size) for part in prompt_pieces(prompt)]
    if any(len(row) > len(pieces) for _, row in weights):
        pieces.append(_piece("(end)", image_height, font_size))
    lines = _wrap(pieces, width - 2 * margin)
    heights = [max((piece.height for piece in line), default=1) for line in lines]
    attended = _ROW_HEIGHT * len(weights) + (4 if weights else 0)
    total = sum(heights) + margin * (len(lines) + 1) + attended * len(lines)
    strip = Image.new("RGB", (width, total + total % 2), PAPER)
    draw = ImageDraw.Draw(strip)
    top, number = margin, 0
    for line, height in zip(lines, heights, strict=True):
        left = margin
        for index, piece in enumerate(line):
            left += piece.space if index else 0
            middle = top + height // 2
            if isinstance(piece.content, str):
                draw.text((left, middle), piece.content, font=typeface, fill=INK, anchor="lm")
            else:
                strip.paste(piece.content, (left, middle - piece.height // 2))
            for row, (colour, shares) in enumerate(weights):
                corner = (left, top + height + 4 + _ROW_HEIGHT * row)
                _draw_weight(draw, corner, piece.width, colour, float(shares[number]))
            left += piece.width
            number += 1
        top += height + margin + attended
    return np.asarray(strip)


def _draw_weight(
    draw: ImageDraw.ImageDraw, corner: tuple[int, int], width: int, colour: Colour, weight: float
) -> None:
    """Draw a weight as a box, the darker the larger, with its percentage where there is space."""
    left, top = corner
    shade = math.sqrt(min(max(weight, 0.0), 1.0))  # small weights stay visible
    fill = tuple(round(255 + (part - 255) * shade) for part in colour)
    draw.rectangle((left, top, left + width - 1, top + _ROW_HEIGHT - 3), fill=fill)
    text, typeface = percent(weight), font(12, bold=True)
    if weight >= 0.01 and typeface.getlength(text) <= width:
        ink = PAPER if shade > 0.6 else INK
        middle = (left + width / 2, top + _ROW_HEIGHT / 2 - 1)
        draw.text(middle, text, font=typeface, fill=ink, anchor="mm")


def percent(probability: float) -> str:
    """Return a probability in percent, as a label."""
    return f"{100 * probability:.0f} %"


@cache
def font(size: int, *, bold: bool = False) -> "ImageFont.FreeTypeFont | ImageFont.ImageFont":
    """Load the typeface that matplotlib ships, so that strips are the same on every machine.

    Args:
        size: Font size in pixels.
        bold: Whether to load the bold face.
    """
    try:
        import matplotlib
    except ImportError:
        return ImageFont.load_default(size)
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(matplotlib.get_data_path(), "fonts", "ttf", name), size)


def _piece(part: "str | PromptImage", image_height: int, font_size: int) -> _Piece:
    space = font_size // 3
    if isinstance(part, str):
        width = math.ceil(font(font_size).getlength(part))
        return _Piece(part, width, font_size, 0 if part[0] in _CLOSING else space)
    picture = thumbnail(part, image_height)
    return _Piece(picture, picture.width, picture.height, space)


def _wrap(pieces: list[_Piece], width: int) -> list[list[_Piece]]:
    lines: list[list[_Piece]] = [[]]
    used = 0
    for piece in pieces:
        needed = piece.width + (piece.space if lines[-1] else 0)
        if lines[-1] and used + needed > width and piece.space:
            lines.append([])
            used, needed = 0, piece.width
        lines[-1].append(piece)
        used += needed
    return lines


def cut_to_object(pixels: np.ndarray, segm: np.ndarray) -> np.ndarray:
    """Crop the image of an object to the object with a margin, never narrower than it is high.

    Args:
        pixels: Shape (H, W, 3), uint8.
        segm: Object ids, shape (H, W), uint8.
    """
    shown = (segm != BACKGROUND_ID) & (pixels != 255).any(axis=2)
    box = Image.fromarray(shown).getbbox()
    if box is None:
        return pixels
    left, top, right, bottom = box
    margin = 4
    height = bottom - top + 2 * margin
    width = max(right - left + 2 * margin, height)
    height = max(height, width // 2)
    left, top = (left + right - width) // 2, (top + bottom - height) // 2
    cut = Image.new("RGB", (width, height), PAPER)
    cut.paste(Image.fromarray(pixels), (-left, -top))
    return np.asarray(cut)
