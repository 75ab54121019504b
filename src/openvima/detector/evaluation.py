"""Evaluation of a detector: class-agnostic COCO metrics of boxes and masks, and images of detections."""

import contextlib
import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from PIL import Image, ImageDraw

from openvima.atomic_io import atomic_write_file
from openvima.detector.detection import Detections
from openvima.detector.frames import Frame
from openvima.errors import ConfigError
from openvima.imports import import_extra
from openvima.render import channels_last
from openvima.video.encoder import png

_CATEGORY = 1  # of all objects
_STATS = 0, 1, 2, 8  # positions of AP, AP50, AP75 and recall in COCOeval.stats

Record = dict[str, Any]


@dataclass(frozen=True, slots=True)
class CocoMetrics:
    """Metrics of boxes or masks, 0 to 1.

    Args:
        ap: Average precision at IoU thresholds 0.50, 0.55, … 0.95.
        ap50: Average precision at IoU 0.5.
        ap75: Average precision at IoU 0.75.
        recall: Average recall at the thresholds of `ap`, with at most 100 detections per image.
    """

    ap: float
    ap50: float
    ap75: float
    recall: float


@dataclass(frozen=True, slots=True)
class CocoEvaluation:
    """COCO metrics of a detector on a set of frames.

    Args:
        boxes: Metrics of the boxes.
        masks: Metrics of the masks.
        frames: Number of frames.
        objects: Number of ground-truth objects.
    """

    boxes: CocoMetrics
    masks: CocoMetrics
    frames: int
    objects: int


def evaluate_detector(detect: Callable[[np.ndarray], Detections], frames: Iterable[Frame]) -> CocoEvaluation:
    """Evaluate a detector on annotated frames.

    Args:
        detect: Maps an image (3, H, W), uint8, to detections with masks and scores.
        frames: The frames.

    Raises:
        ConfigError: The frames contain no object.
        MissingExtraError: pycocotools is not installed.
    """
    require_pycocotools()
    from pycocotools import mask as mask_utils

    def annotate(regions: list[Record], mask: np.ndarray, edges: np.ndarray, **fields: float) -> None:
        left, upper, right, lower = (float(edge) for edge in edges)
        size = [right - left, lower - upper]
        regions.append(
            {
                "id": len(regions) + 1,
                "image_id": len(images),
                "iscrowd": 0,
                "bbox": [left, upper, *size],
                "segmentation": mask_utils.encode(np.asfortranarray(mask.astype(np.uint8))),
                "area": float(size[0] * size[1]),
                "category_id": _CATEGORY,
                **fields,
            }
        )

    images, truth, found = [], [], []
    for frame in frames:
        for mask, edges in zip(frame.masks, frame.boxes, strict=True):
            annotate(truth, mask, edges)
        detections = detect(frame.rgb)
        assert detections.masks is not None and detections.scores is not None  # as required
        boxes = detections.boxes + np.array([0, 0, 1, 1])  # from inclusive pixels to edges
        for mask, edges, score in zip(detections.masks, boxes, detections.scores, strict=True):
            annotate(found, mask, edges, score=float(score))
        _, height, width = frame.rgb.shape
        images.append({"id": len(images), "height": height, "width": width})
    if not truth:
        raise ConfigError("the frames contain no object; give others to evaluate a detector on.")
    return CocoEvaluation(
        boxes=_metrics(images, truth, found, "bbox"),
        masks=_metrics(images, truth, found, "segm"),
        frames=len(images),
        objects=len(truth),
    )


def require_pycocotools() -> None:
    """Raise a MissingExtraError that names the extra if pycocotools cannot be imported."""
    import_extra(
        "pycocotools", "COCO metrics need pycocotools; install it with: pip install 'openvima[detector]'"
    )


def _metrics(
    images: list[Record], truth: list[Record], found: list[Record], kind: Literal["bbox", "segm"]
) -> CocoMetrics:
    from pycocotools.cocoeval import COCOeval

    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        evaluation = COCOeval(_coco(images, truth), _coco(images, found), kind)
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return CocoMetrics(*(float(evaluation.stats[k]) for k in _STATS))


def _coco(images: list[Record], annotations: list[Record]) -> Any:
    from pycocotools.coco import COCO

    coco: Any = COCO()
    categories = [{"id": _CATEGORY, "name": "object"}]
    coco.dataset = {"images": images, "annotations": annotations, "categories": categories}
    coco.createIndex()
    return coco


COLOURS = ((0, 158, 115), (230, 159, 0), (86, 180, 233), (204, 121, 167), (240, 228, 66), (213, 94, 0))
DASHES = ((255, 255, 255), (0, 0, 0))  # visible on any background
SHEET = (214, 214, 214)  # prompt images are white
SCALE, GAP, COLUMNS = 3, 8, 2
LEAST_DRAWN = 0.5  # score
DASH = 6  # pixels


def draw_detections(frame: Frame, found: Detections) -> Image.Image:
    """Draw the detections of a frame.

    Args:
        frame: The frame; its ground-truth boxes are dashed.
        found: The detections, with masks and scores; those with a score of at least 0.5 are drawn.
    """
    assert found.masks is not None and found.scores is not None  # as required
    kept = found.scores >= LEAST_DRAWN
    boxes, masks, scores = found.boxes[kept], found.masks[kept], found.scores[kept]
    rgb = channels_last(frame.rgb).astype(np.float64)
    for number, mask in enumerate(masks):
        rgb[mask] = 0.55 * rgb[mask] + 0.45 * np.array(COLOURS[number % len(COLOURS)])
    pixels = rgb.astype(np.uint8).repeat(SCALE, axis=0).repeat(SCALE, axis=1)
    for left, upper, right, lower in (frame.boxes * SCALE).astype(int).tolist():
        pixels[[upper, lower - 1], left:right] = _dashes(right - left)
        pixels[upper:lower, [left, right - 1]] = _dashes(lower - upper)[:, None]
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image)
    for number, (left, upper, right, lower) in enumerate(boxes.tolist()):
        colour = COLOURS[number % len(COLOURS)]
        corners = [SCALE * left, SCALE * upper, SCALE * (right + 1) - 1, SCALE * (lower + 1) - 1]
        draw.rectangle(corners, outline=colour, width=2)
        above = (corners[0] + 2, max(0, corners[1] - 12))
        draw.text(above, f"{scores[number]:.2f}", fill=colour)
    return image


def save_grid(images: Sequence[Image.Image], path: Path) -> None:
    """Write images of one size as a grid to a PNG file."""
    width, height = images[0].size
    rows = -(-len(images) // COLUMNS)
    size = (COLUMNS * (width + GAP) + GAP, rows * (height + GAP) + GAP)
    sheet = Image.new("RGB", size, SHEET)
    for number, image in enumerate(images):
        row, column = divmod(number, COLUMNS)
        sheet.paste(image, (GAP + column * (width + GAP), GAP + row * (height + GAP)))
    atomic_write_file(path, png(sheet))


def _dashes(length: int) -> np.ndarray:
    """Colours of a dashed line, shape (length, 3)."""
    return np.where(np.arange(length)[:, None] // DASH % 2, *DASHES)
