"""Numba kernels of the detector: box decoding, suppression, RoIAlign, pasting."""

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
def align(features, boxes, images, levels, level, stride, sampling_ratio, out):
    """Average samples of features (B, H, W, C) in cells of the boxes (R, 4) of a level, as `roi_align` does.

    `images` (R,) and `levels` (R,) are those of the boxes; `out` is (R, C, size, size). Bilinear weights are
    products of one for the row and one for the column, so features are summed over rows first. Indices are
    unsigned, since the check for negative ones keeps loops from being vectorised: three times as fast.
    """
    _, height, width, _ = features.shape
    size, channels, pitch = out.shape[2], np.uint64(out.shape[1]), np.uint64(width * out.shape[1])
    strip, cell = np.empty(pitch, out.dtype), np.empty(channels, out.dtype)  # sums of a row of cells, of one
    for r in range(len(boxes)):
        if levels[r] != level:
            continue
        left, upper, right, lower = boxes[r, 0], boxes[r, 1], boxes[r, 2], boxes[r, 3]
        x, x_weights = _sample_points(left, right, width, stride, size, sampling_ratio, out.dtype)
        y, y_weights = _sample_points(upper, lower, height, stride, size, sampling_ratio, out.dtype)
        num_x, num_y = len(x) // size, len(y) // size
        first, last = x.min() * channels, (x.max() + np.uint64(1)) * channels
        frame = features[images[r]].reshape(-1)
        for row in range(size):
            for k in range(first, last):
                strip[k] = 0
            for i in range(row * num_y, (row + 1) * num_y):
                a, b = y[i, 0] * pitch, y[i, 1] * pitch
                a_weight, b_weight = y_weights[i, 0], y_weights[i, 1]
                for k in range(first, last):
                    strip[k] += a_weight * frame[a + k] + b_weight * frame[b + k]
            for column in range(size):
                for k in range(channels):
                    cell[k] = 0
                for j in range(column * num_x, (column + 1) * num_x):
                    a, b = x[j, 0] * channels, x[j, 1] * channels
                    a_weight, b_weight = x_weights[j, 0], x_weights[j, 1]
                    for k in range(channels):
                        cell[k] += a_weight * strip[a + k] + b_weight * strip[b + k]
                for k in range(channels):
                    out[r, k, row, column] = cell[k]


@njit
def _sample_points(low, high, length, stride, size, sampling_ratio, dtype):
    """Return the features beside each sampling point of an axis and their weights, (size · samples, 2)."""
    start, extent = low / stride - 0.5, (high - low) / stride
    samples = sampling_ratio if sampling_ratio else max(1, int(np.ceil(extent / size)))
    indices, weights = np.zeros((size * samples, 2), np.uint64), np.zeros((size * samples, 2), dtype)
    for n in range(len(indices)):
        point = start + extent * (n + 0.5) / (size * samples)
        if -1 <= point <= length:
            point = min(max(point, 0.0), length - 1.0)
            first = min(int(point), max(length - 2, 0))
            indices[n, 0], indices[n, 1] = first, min(first + 1, length - 1)
            weights[n, 0], weights[n, 1] = (first + 1 - point) / samples, (point - first) / samples
    return indices, weights


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
