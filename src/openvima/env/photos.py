"""Photos of objects as prompt images: bounded reading of PNG files."""

from pathlib import Path

import numpy as np
from PIL import Image

from openvima.errors import InputFileError
from openvima.input_files import decode_png, read_png
from openvima.render.rasteriser import PHOTO_WHITE
from openvima.scene import PhotoImage
from openvima.scene.prompt import PHOTO_SIDE

MAX_PNG_BYTES = 32 * 2**20
MAX_PNG_SIDE = 4096  # pixels


def read_photo(file: Path) -> PhotoImage:
    """Read a PNG file with an object on white or transparent background.

    The background is cut off; the rest is resized to the size of rendered prompt objects.

    Raises:
        InputFileError: There is no such file, it is no regular file, no PNG, too large, or empty.
    """
    try:
        picture = read_png(file, max_bytes=MAX_PNG_BYTES, max_side=MAX_PNG_SIDE)
    except InputFileError as error:
        raise InputFileError(f"photo {error}") from None
    return _photo(picture, f"photo {str(file)!r}")


def photo_from_bytes(content: bytes) -> PhotoImage:
    """Read the content of a PNG file; see `read_photo`.

    Raises:
        InputFileError: It is no PNG, too large, or empty.
    """
    label = "the photo"
    return _photo(decode_png(content, label, max_bytes=MAX_PNG_BYTES, max_side=MAX_PNG_SIDE), label)


def _photo(picture: Image.Image, label: str) -> PhotoImage:
    """Cut a picture to its object and resize it."""
    paper = Image.new("RGBA", picture.size, "white")
    pixels = np.asarray(Image.alpha_composite(paper, picture).convert("RGB"))
    is_object = (pixels < PHOTO_WHITE).any(axis=-1)
    if not is_object.any():
        raise InputFileError(f"{label} is all white; it must show an object on white.")
    rows, columns = np.flatnonzero(is_object.any(axis=-1)), np.flatnonzero(is_object.any(axis=0))
    return _fitted(Image.fromarray(pixels[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]))


def _fitted(picture: Image.Image) -> PhotoImage:
    """Resize a picture so that its longer side is `PHOTO_SIDE`."""
    scale = PHOTO_SIDE / max(picture.size)
    width, height = (max(1, round(side * scale)) for side in picture.size)
    how = Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST
    return PhotoImage(width, height, picture.resize((width, height), how).tobytes())
