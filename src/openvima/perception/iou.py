"""Which of the objects that were found are which of the true ones: those whose boxes overlap most."""

import numpy as np

from openvima.perception.objects import ObjectViews

IOU_THRESHOLD = 0.5  # intersection over union, as boxes are commonly called right


def object_iou(some: ObjectViews, others: ObjectViews) -> np.ndarray:
    """Return how much objects overlap others, shape (objects, others), float64.

    That is intersection over union of their boxes, in the view in which it is larger; 0 where no view shows
    both.
    """
    return box_iou(some.boxes, some.masks, others.boxes, others.masks)


def box_iou(
    some: np.ndarray, some_shown: np.ndarray, others: np.ndarray, others_shown: np.ndarray
) -> np.ndarray:
    """Return the same from boxes, (2, N, 4) and (2, M, 4), and where they are shown, (2, N) and (2, M)."""
    ours, theirs = _edges(some)[:, :, None], _edges(others)[:, None]
    first, last = np.maximum(ours[..., :2], theirs[..., :2]), np.minimum(ours[..., 2:], theirs[..., 2:])
    shared = np.prod(np.maximum(last - first, 0), axis=-1)
    both_shown = some_shown[:, :, None] & others_shown[:, None]
    shares = np.where(both_shown, shared / (_areas(ours) + _areas(theirs) - shared), 0.0)
    return shares.max(axis=0)


def match_ids_to_slots(found: ObjectViews, true: ObjectViews) -> dict[int, int]:
    """Say which slot shows each true object that was found.

    Always the two are paired that overlap most of those that are left, so that no slot counts twice.

    Args:
        found: What a detector found.
        true: What the segmentation shows of the same moment.

    Returns:
        Id of a true object to the slot in `found`; those without a box that overlaps theirs by half are left
        out.
    """
    shares = object_iou(found, true)
    slots = {}
    while shares.size and shares.max() >= IOU_THRESHOLD:
        slot, row = (int(index) for index in np.unravel_index(shares.argmax(), shares.shape))
        slots[int(true.ids[row])] = slot
        shares[slot], shares[:, row] = 0, 0
    return slots


def _edges(boxes: np.ndarray) -> np.ndarray:
    """Left, upper, right and lower edge of the boxes, shape (2, N, 4); a pixel is one wide."""
    sizes = boxes[..., :1:-1]  # width and height, one pixel short
    first = boxes[..., :2] - sizes // 2
    return np.concatenate([first, first + sizes + 1], axis=-1)


def _areas(edges: np.ndarray) -> np.ndarray:
    return np.prod(edges[..., 2:] - edges[..., :2], axis=-1)
