"""COCO metrics of a detector: class-agnostic average precision of boxes and masks."""

import contextlib
import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from openvima.detector.detection import Detections
from openvima.detector.frames import Frame
from openvima.errors import ConfigError
from openvima.imports import import_extra

_CATEGORY = 1  # of all objects
_AP, _AP50, _AP75, _RECALL = 0, 1, 2, 8  # positions in COCOeval.stats

Record = dict[str, Any]  # Any: numbers, lists and run-length encodings, as COCO has them


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

    def region(mask: np.ndarray, edges: np.ndarray) -> Record:
        left, upper, right, lower = (float(edge) for edge in edges)
        size = [right - left, lower - upper]
        return {
            "bbox": [left, upper, *size],
            "segmentation": mask_utils.encode(np.asfortranarray(mask.astype(np.uint8))),
            "area": float(size[0] * size[1]),
            "category_id": _CATEGORY,
        }

    images, truth, found = [], [], []
    for number, frame in enumerate(frames):
        _, height, width = frame.rgb.shape
        images.append({"id": number, "height": height, "width": width})
        for mask, edges in zip(frame.masks, frame.boxes, strict=True):
            truth.append({"id": len(truth) + 1, "image_id": number, "iscrowd": 0, **region(mask, edges)})
        detections = detect(frame.rgb)
        assert detections.masks is not None and detections.scores is not None  # as required
        boxes = detections.boxes + np.array([0, 0, 1, 1])  # from inclusive pixels to edges
        for mask, edges, score in zip(detections.masks, boxes, detections.scores, strict=True):
            found.append({"image_id": number, "score": float(score), **region(mask, edges)})
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
    if not found:
        return CocoMetrics(0.0, 0.0, 0.0, 0.0)
    from pycocotools.cocoeval import COCOeval

    found = [{"id": number, "iscrowd": 0, **one} for number, one in enumerate(found, start=1)]
    with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
        evaluation = COCOeval(_coco(images, truth), _coco(images, found), kind)
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    ap, ap50, ap75, recall = (float(evaluation.stats[k]) for k in (_AP, _AP50, _AP75, _RECALL))
    return CocoMetrics(ap, ap50, ap75, recall)


def _coco(images: list[Record], annotations: list[Record]) -> Any:  # Any: pycocotools has no types
    from pycocotools.coco import COCO

    coco: Any = COCO()  # Any: as above
    categories = [{"id": _CATEGORY, "name": "object"}]
    coco.dataset = {"info": {}, "images": images, "annotations": annotations, "categories": categories}
    coco.createIndex()
    return coco
