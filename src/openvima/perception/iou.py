"""Intersection over union of boxes, and matching of detected to true objects by it."""

import numpy as np

from openvima.perception.objects import ObjectViews

IOU_THRESHOLD = 0.5  # of a match


def object_iou(objects: ObjectViews, others: ObjectViews) -> np.ndarray:
    """Return the pairwise IoU of objects, shape (objects, others), float64.

    It is the larger one of both views; 0 where no view contains both boxes.
    """
    return box_iou(objects.boxes, objects.masks, others.boxes, others.masks)


def box_iou(
    boxes: np.ndarray, is_visible: np.ndarray, others: np.ndarray, others_visible: np.ndarray
) -> np.ndarray:
    """Return the same for boxes, (2, N, 4) and (2, M, 4), with visibility masks, (2, N) and (2, M)."""
    ours, theirs = _edges(boxes)[:, :, None], _edges(others)[:, None]
    first, last = np.maximum(ours[..., :2], theirs[..., :2]), np.minimum(ours[..., 2:], theirs[..., 2:])
    intersection = np.prod(np.maximum(last - first, 0), axis=-1)
    both_visible = is_visible[:, :, None] & others_visible[:, None]
    union = _areas(ours) + _areas(theirs) - intersection
    return np.where(both_visible, intersection / union, 0.0).max(axis=0)


def match_ids_to_slots(found: ObjectViews, true: ObjectViews) -> dict[int, int]:
    """Match true objects to detections greedily, by descending IoU.

    Args:
        found: Detected objects.
        true: Objects of the segmentation in the same observation.

    Returns:
        Id of a true object to its slot in `found`; objects below `IOU_THRESHOLD` are omitted.
    """
    iou = object_iou(found, true)
    slots = {}
    while iou.size and iou.max() >= IOU_THRESHOLD:
        slot, row = (int(index) for index in np.unravel_index(iou.argmax(), iou.shape))
        slots[int(true.ids[row])] = slot
        iou[slot], iou[:, row] = 0, 0
    return slots


def _edges(boxes: np.ndarray) -> np.ndarray:
    """Left, upper, right and lower edge of the boxes, shape (2, N, 4); a pixel is one wide."""
    sizes = boxes[..., :1:-1]  # width and height, one pixel short
    first = boxes[..., :2] - sizes // 2
    return np.concatenate([first, first + sizes + 1], axis=-1)


def _areas(edges: np.ndarray) -> np.ndarray:
    return np.prod(edges[..., 2:] - edges[..., :2], axis=-1)
