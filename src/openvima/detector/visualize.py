"""Images of detections: coloured masks, boxes and scores; ground-truth boxes are dashed."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write_file
from openvima.detector.detection import Detections
from openvima.detector.frames import Frame
from openvima.render import channels_last

COLOURS = ((0, 158, 115), (230, 159, 0), (86, 180, 233), (204, 121, 167), (240, 228, 66), (213, 94, 0))
DASHES = ((255, 255, 255), (0, 0, 0))  # visible on any background
SHEET = (214, 214, 214)  # prompt images are white
SCALE, GAP = 3, 8
DASH = 6  # pixels


def draw_detections(frame: Frame, found: Detections, *, score: float = 0.5) -> Image.Image:
    """Draw the detections of a frame.

    Args:
        frame: The frame; its ground-truth boxes are dashed.
        found: The detections.
        score: Least score of the detections that are drawn.
    """
    scores = np.ones(len(found)) if found.scores is None else found.scores
    found = found.select(scores >= score)
    rgb = channels_last(frame.rgb).astype(np.float64)
    for number, mask in enumerate(found.masks if found.masks is not None else ()):
        rgb[mask] = 0.55 * rgb[mask] + 0.45 * np.array(COLOURS[number % len(COLOURS)])
    height, width = rgb.shape[:2]
    image = Image.fromarray(rgb.astype(np.uint8)).resize(
        (SCALE * width, SCALE * height), Image.Resampling.NEAREST
    )
    draw = ImageDraw.Draw(image)
    for edges in frame.boxes * SCALE:
        _draw_dashed_box(draw, edges.tolist())
    for number, (left, upper, right, lower) in enumerate(found.boxes.tolist()):
        colour = COLOURS[number % len(COLOURS)]
        corners = [SCALE * left, SCALE * upper, SCALE * (right + 1) - 1, SCALE * (lower + 1) - 1]
        draw.rectangle(corners, outline=colour, width=2)
        if found.scores is not None:
            text = f"{found.scores[number]:.2f}"
            draw.text((corners[0] + 2, max(0, corners[1] - 12)), text, fill=colour)
    return image


def save_grid(images: Sequence[Image.Image], path: Path, *, columns: int = 2) -> None:
    """Write images of one size as a grid to a PNG file."""
    width, height = images[0].size
    rows = -(-len(images) // columns)
    size = (columns * (width + GAP) + GAP, rows * (height + GAP) + GAP)
    sheet = Image.new("RGB", size, SHEET)
    for number, image in enumerate(images):
        row, column = divmod(number, columns)
        sheet.paste(image, (GAP + column * (width + GAP), GAP + row * (height + GAP)))
    content = BytesIO()
    sheet.save(content, "PNG", optimize=True)
    atomic_write_file(path, content.getvalue())


def _draw_dashed_box(draw: ImageDraw.ImageDraw, edges: Sequence[float]) -> None:
    left, upper, right, lower = edges
    right, lower = right - 1, lower - 1
    light, dark = DASHES
    draw.rectangle([left, upper, right, lower], outline=dark)
    for x in np.arange(left, right, 2 * DASH).tolist():
        for y in (upper, lower):
            draw.line([x, y, min(x + DASH, right), y], fill=light)
    for y in np.arange(upper, lower, 2 * DASH).tolist():
        for x in (left, right):
            draw.line([x, y, x, min(y + DASH, lower)], fill=light)
