"""Numba kernel of the detector: greedy non-maximum suppression."""

import numpy as np
from numba import njit


@njit(cache=True)
def suppress(boxes, iou_threshold):
    """Return which boxes (N, 4), float64, best first, are kept, shape (N,), bool."""
    kept = np.ones(len(boxes), np.bool_)
    for i in range(len(boxes)):
        if not kept[i]:
            continue
        area = (boxes[i, 2] - boxes[i, 0]) * (boxes[i, 3] - boxes[i, 1])
        for j in range(i + 1, len(boxes)):
            width = min(boxes[i, 2], boxes[j, 2]) - max(boxes[i, 0], boxes[j, 0])
            height = min(boxes[i, 3], boxes[j, 3]) - max(boxes[i, 1], boxes[j, 1])
            if width > 0 and height > 0:
                other = (boxes[j, 2] - boxes[j, 0]) * (boxes[j, 3] - boxes[j, 1])
                if width * height > iou_threshold * (area + other - width * height):
                    kept[j] = False
    return kept
