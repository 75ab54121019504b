"""Numba kernels of the detector: box decoding, suppression and pasting of masks."""

import numpy as np

from openvima.compilation import njit


@njit
def decode(deltas, references, weights, max_log_scale, limits, boxes):
    """Fill `boxes` (N, 4) as `decode_boxes` does; `weights` are four floats, `limits` width and height."""
    for n in range(len(boxes)):
        for axis in range(2):
            low, high = np.float64(references[n, axis]), np.float64(references[n, axis + 2])
            centre = (low + high) / 2 + deltas[n, axis] / weights[axis] * (high - low)
            half = np.exp(min(deltas[n, axis + 2] / weights[axis + 2], max_log_scale)) * (high - low) / 2
            boxes[n, axis] = min(max(centre - half, 0.0), limits[axis])
            boxes[n, axis + 2] = min(max(centre + half, 0.0), limits[axis])


@njit
def suppress(boxes, order, groups, iou_threshold):
    """Return which boxes (N, 4) are kept, shape (N,), bool, in the order of their indices `order` (N,).

    Boxes without area are dropped. Boxes of different groups (N,) do not suppress each other.
    """
    left, upper, right, lower = boxes.astype(np.float64)[order].T
    kept = (right > left) & (lower > upper)
    for i in range(len(order)):
        if not kept[i]:
            continue
        area = (right[i] - left[i]) * (lower[i] - upper[i])
        for j in range(i + 1, len(order)):
            if not kept[j] or groups[order[j]] != groups[order[i]]:
                continue
            width = min(right[i], right[j]) - max(left[i], left[j])
            height = min(lower[i], lower[j]) - max(upper[i], upper[j])
            if width > 0 and height > 0:
                other = (right[j] - left[j]) * (lower[j] - upper[j])
                if width * height > iou_threshold * (area + other - width * height):
                    kept[j] = False
    return kept


@njit
def paste(probabilities, boxes, out):
    """Write where masks (N, S, S) inside boxes (N, 4) reach 0.5 to `out` (N, H, W), bool, which is False."""
    size = probabilities.shape[1]
    _, height, width = out.shape
    for n in range(len(boxes)):
        left, upper, right, lower = boxes[n]
        across, down = size / max(right - left, 1e-6), size / max(lower - upper, 1e-6)
        # Cells reach half a cell beyond the box, with decreasing weights.
        for row in range(max(0, int(upper - 0.5 / down)), min(height, int(lower + 0.5 / down) + 1)):
            y = (row + 0.5 - upper) * down - 0.5
            for column in range(max(0, int(left - 0.5 / across)), min(width, int(right + 0.5 / across) + 1)):
                x = (column + 0.5 - left) * across - 0.5
                out[n, row, column] = _read(probabilities[n], y, x) >= 0.5


@njit
def _read(plane, y, x):
    """Interpolate a plane (S, S) at a point; it is zero outside."""
    row, column = int(np.floor(y)), int(np.floor(x))
    total = 0.0
    for i in range(max(row, 0), min(row + 2, plane.shape[0])):
        for j in range(max(column, 0), min(column + 2, plane.shape[1])):
            total += (1 - abs(y - i)) * (1 - abs(x - j)) * plane[i, j]
    return total
