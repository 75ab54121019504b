"""COCO metrics of a detector: average precision of boxes and of masks, whatever the kind of object."""

import contextlib
import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from openvima.detector.frames import Frame
from openvima.errors import ConfigError, MissingExtraError
from openvima.policies.detection import Detections

_CATEGORY = 1  # of all objects
_AP, _AP50, _AP75, _RECALL = 0, 1, 2, 8  # where COCO's summary holds them


@dataclass(frozen=True, slots=True)
class Precision:
    """How well boxes or masks fit; shares of 1.

    Args:
        ap: Average precision, mean over overlaps of 0.50, 0.55, … 0.95.
        ap50: At an overlap of 0.5.
        ap75: At an overlap of 0.75.
        recall: Share of the objects that is found, mean over the same overlaps.
    """

    ap: float
    ap50: float
    ap75: float
    recall: float


@dataclass(frozen=True, slots=True)
class DetectorScore:
    """COCO metrics of a detector on some frames.

    Args:
        boxes: Of the boxes.
        masks: Of the masks.
        frames: Number of frames.
        objects: Number of objects in them.
    """

    boxes: Precision
    masks: Precision
    frames: int
    objects: int


def score_detector(detect: Callable[[np.ndarray], Detections], frames: Iterable[Frame]) -> DetectorScore:
    """Compare what a detector finds with what the frames show.

    Args:
        detect: From an image (3, H, W), uint8, to what is found in it, with masks and scores.
        frames: The frames.

    Raises:
        ConfigError: The frames show no object.
        MissingExtraError: pycocotools is not installed.
    """
    require_pycocotools()
    from pycocotools import mask as coder

    def region(mask: np.ndarray, edges: np.ndarray) -> dict[str, Any]:  # Any: COCO's record
        left, upper, right, lower = (float(edge) for edge in edges)
        encoded = coder.encode(np.asfortranarray(mask.astype(np.uint8)))
        size = [right - left, lower - upper]
        return {
            "bbox": [left, upper, *size],
            "segmentation": encoded,
            "area": float(size[0] * size[1]),
            "category_id": _CATEGORY,
        }

    images, known, found = [], [], []
    for number, frame in enumerate(frames):
        _, height, width = frame.rgb.shape
        images.append({"id": number, "height": height, "width": width})
        for mask, edges in zip(frame.masks, frame.boxes, strict=True):
            own = {"id": len(known) + 1, "image_id": number, "iscrowd": 0, **region(mask, edges)}
            known.append(own)
        seen = detect(frame.rgb)
        assert seen.masks is not None and seen.scores is not None  # as asked for
        edges = seen.boxes + np.array([0, 0, 1, 1])  # the last pixels still belong to the object
        for mask, edge, score in zip(seen.masks, edges, seen.scores, strict=True):
            found.append({"image_id": number, "score": float(score), **region(mask, edge)})
    if not known:
        raise ConfigError("the frames show no object; give others to score a detector on.")
    return DetectorScore(
        boxes=_precision(images, known, found, "bbox"),
        masks=_precision(images, known, found, "segm"),
        frames=len(images),
        objects=len(known),
    )


def require_pycocotools() -> None:
    """Raise a MissingExtraError that names the extra if pycocotools cannot be imported."""
    try:
        import pycocotools  # noqa: F401  # whether it is there
    except ImportError as error:
        raise MissingExtraError(
            "scoring a detector needs pycocotools; install it with: pip install 'openvima[detector]'"
        ) from error


def _precision(
    images: list[dict[str, Any]],
    known: list[dict[str, Any]],
    found: list[dict[str, Any]],
    kind: Literal["bbox", "segm"],
) -> Precision:  # Any: COCO's records
    if not found:
        return Precision(0.0, 0.0, 0.0, 0.0)
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    truth: Any = COCO()  # Any: the records in it are mere dictionaries
    truth.dataset = {
        "info": {},
        "images": images,
        "annotations": known,
        "categories": [{"id": _CATEGORY, "name": "object"}],
    }
    with contextlib.redirect_stdout(io.StringIO()):  # it prints as it goes
        truth.createIndex()
        results: Any = COCO()
        results.dataset = {
            **truth.dataset,
            "annotations": [{"id": number + 1, "iscrowd": 0, **one} for number, one in enumerate(found)],
        }
        results.createIndex()
        evaluation = COCOeval(truth, results, kind)
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    stats = evaluation.stats
    return Precision(float(stats[_AP]), float(stats[_AP50]), float(stats[_AP75]), float(stats[_RECALL]))
