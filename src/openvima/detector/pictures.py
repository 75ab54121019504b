"""Pictures of detections to look at: masks in colour, boxes and scores; dashed boxes where objects are."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write_file
from openvima.detector.frames import Frame
from openvima.policies.detection import Detections
from openvima.render import channels_last

COLOURS = ((0, 158, 115), (230, 159, 0), (86, 180, 233), (204, 121, 167), (240, 228, 66), (213, 94, 0))
KNOWN, UNDER_KNOWN = (255, 255, 255), (0, 0, 0)  # one of them can be seen on any background
PAPER = (214, 214, 214)  # pictures of prompts are white
ENLARGE, GAP = 3, 8
DASH = 6  # pixels


def draw_detections(frame: Frame, found: Detections, *, score: float = 0.5) -> Image.Image:
    """Draw what was found in a frame.

    Args:
        frame: The image and the objects that it shows, whose boxes are dashed.
        found: What a detector found.
        score: What is below is left out.
    """
    scores = np.ones(len(found)) if found.scores is None else found.scores
    found = found.select(scores >= score)
    rgb = channels_last(frame.rgb).astype(np.float64)
    for number, mask in enumerate(found.masks if found.masks is not None else ()):
        rgb[mask] = 0.55 * rgb[mask] + 0.45 * np.array(COLOURS[number % len(COLOURS)])
    height, width = rgb.shape[:2]
    picture = Image.fromarray(rgb.astype(np.uint8)).resize(
        (ENLARGE * width, ENLARGE * height), Image.Resampling.NEAREST
    )
    draw = ImageDraw.Draw(picture)
    for edges in frame.boxes * ENLARGE:
        _dashed(draw, edges.tolist())
    for number, (left, upper, right, lower) in enumerate(found.boxes.tolist()):
        colour = COLOURS[number % len(COLOURS)]
        corners = [ENLARGE * left, ENLARGE * upper, ENLARGE * (right + 1) - 1, ENLARGE * (lower + 1) - 1]
        draw.rectangle(corners, outline=colour, width=2)
        if found.scores is not None:
            text = f"{found.scores[number]:.2f}"
            draw.text((corners[0] + 2, max(0, corners[1] - 12)), text, fill=colour)
    return picture


def save_sheet(pictures: Sequence[Image.Image], path: Path, *, columns: int = 2) -> None:
    """Write pictures of one size side by side and below each other, on grey, as a PNG file."""
    width, height = pictures[0].size
    rows = -(-len(pictures) // columns)
    size = (columns * (width + GAP) + GAP, rows * (height + GAP) + GAP)
    sheet = Image.new("RGB", size, PAPER)
    for number, picture in enumerate(pictures):
        row, column = divmod(number, columns)
        sheet.paste(picture, (GAP + column * (width + GAP), GAP + row * (height + GAP)))
    content = BytesIO()
    sheet.save(content, "PNG", optimize=True)
    atomic_write_file(path, content.getvalue())


def _dashed(draw: ImageDraw.ImageDraw, edges: Sequence[float]) -> None:
    left, upper, right, lower = edges
    right, lower = right - 1, lower - 1
    draw.rectangle([left, upper, right, lower], outline=UNDER_KNOWN)
    for x in np.arange(left, right, 2 * DASH).tolist():
        for y in (upper, lower):
            draw.line([x, y, min(x + DASH, right), y], fill=KNOWN)
    for y in np.arange(upper, lower, 2 * DASH).tolist():
        for x in (left, right):
            draw.line([x, y, x, min(y + DASH, lower)], fill=KNOWN)
