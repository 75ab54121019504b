"""Numba kernels of perception: extents of objects, area-resized crops, most interior points.

Only loops over arrays that the caller prepared; `objects.py` checks shapes and owns the documentation.
"""

import numpy as np

from openvima.compilation import njit

CROP_SIZE = 32
_FAR = np.int32(1 << 20)


@njit
def object_extents(segm, extents, num_pixels):
    """Fill `extents` (256, 4) int64 with xmin, xmax, ymin, ymax of every id and `num_pixels` (256,)."""
    height, width = segm.shape
    num_pixels[:] = 0
    extents[:, 0], extents[:, 1], extents[:, 2], extents[:, 3] = width, -1, height, -1
    for row in range(height):
        start = 0
        while start < width:  # a run of equal ids at a time: most pixels repeat the one before
            k = segm[row, start]
            end = start + 1
            while end < width and segm[row, end] == k:
                end += 1
            num_pixels[k] += end - start
            extents[k, 0] = min(extents[k, 0], start)
            extents[k, 1] = max(extents[k, 1], end - 1)
            extents[k, 2] = min(extents[k, 2], row)
            extents[k, 3] = row
            start = end


@njit
def halve_frame(frame, half):
    """Average 2 × 2 pixels of `frame` (3, 2 H, 2 W) into `half` (3, H, W), halves rounded up."""
    for channel in range(half.shape[0]):
        for row in range(half.shape[1]):
            for column in range(half.shape[2]):
                total = np.int64(2)
                for i in range(2):
                    for j in range(2):
                        total += frame[channel, 2 * row + i, 2 * column + j]
                half[channel, row, column] = total >> 2


@njit
def resize_square(square, size, scratch, crop):
    """Resize `square[:, :size, :size]` to `crop` (3, 32, 32) uint8 as OpenCV's area interpolation does.

    `scratch` is float64 of shape (32, size) at least.
    """
    if size == CROP_SIZE:
        crop[:] = square[:, :size, :size]
    elif size == 2 * CROP_SIZE:
        halve_frame(square, crop)
    elif size > CROP_SIZE:
        _shrink(square, size, scratch, crop)
    else:
        _enlarge(square, size, crop)


@njit
def _shrink(square, size, scratch, crop):
    """Weigh every source pixel by the area that it shares with the target pixel."""
    scale = size / CROP_SIZE
    for channel in range(3):
        for row in range(CROP_SIZE):
            low = row * scale
            high = low + scale
            for column in range(size):
                scratch[row, column] = 0.0
            for i in range(int(low), min(int(np.ceil(high)), size)):
                shared = min(i + 1.0, high) - max(np.float64(i), low)
                for column in range(size):
                    scratch[row, column] += shared * square[channel, i, column]
        for column in range(CROP_SIZE):
            low = column * scale
            high = low + scale
            first = int(low)
            last = min(int(np.ceil(high)), size)
            for row in range(CROP_SIZE):
                total = 0.0
                for j in range(first, last):
                    total += (min(j + 1.0, high) - max(np.float64(j), low)) * scratch[row, j]
                crop[channel, row, column] = np.uint8(np.rint(total / (scale * scale)))


@njit
def _source(index, size):
    """Source pixel, its neighbour's index and their weights of 2048 for one target index."""
    inverse = np.float64(CROP_SIZE) / size
    j = int(np.floor(index * (size / CROP_SIZE)))
    fraction = np.float32((index + 1) - (j + 1) * inverse)
    fraction = np.float32(0.0) if fraction <= 0 else np.float32(fraction - np.floor(fraction))
    if j >= size - 1:
        j = size - 1
        fraction = np.float32(0.0)
    w1 = np.int64(np.rint(fraction * np.float32(2048)))
    w0 = np.int64(np.rint((np.float32(1.0) - fraction) * np.float32(2048)))
    return j, min(j + 1, size - 1), w0, w1


@njit
def _enlarge(square, size, crop):
    """Fixed-point linear interpolation, which OpenCV uses for "area" when it has to enlarge."""
    for channel in range(3):
        for row in range(CROP_SIZE):
            i0, i1, v0, v1 = _source(row, size)
            for column in range(CROP_SIZE):
                j0, j1, w0, w1 = _source(column, size)
                upper = w0 * square[channel, i0, j0] + w1 * square[channel, i0, j1]
                lower = w0 * square[channel, i1, j0] + w1 * square[channel, i1, j1]
                value = ((v0 * (upper >> 4)) >> 16) + ((v1 * (lower >> 4)) >> 16) + 2
                crop[channel, row, column] = value >> 2


@njit
def most_interior_pixel(mask, distance):
    """Return column and row of the pixel of an object that is farthest from its outline.

    Distances are those of the 3-4 chamfer metric; among equals the one nearest the centroid wins, then the
    first in reading order. `mask` is bool, (H, W), and `distance` scratch, (H + 2, W + 2) int32, whose border
    means "outside".
    """
    height, width = mask.shape
    count = 0
    sum_x = 0
    sum_y = 0
    for i in range(height + 2):
        for j in range(width + 2):
            inside = 1 <= i <= height and 1 <= j <= width and mask[i - 1, j - 1]
            distance[i, j] = _FAR if inside else 0
            if inside:
                count += 1
                sum_x += j
                sum_y += i
    for i in range(1, height + 1):
        for j in range(1, width + 1):
            d = min(distance[i, j], distance[i, j - 1] + 3, distance[i - 1, j] + 3)
            distance[i, j] = min(d, distance[i - 1, j - 1] + 4, distance[i - 1, j + 1] + 4)
    best = -1
    best_off = 0
    column = 0
    row = 0
    for i in range(height, 0, -1):
        for j in range(width, 0, -1):
            d = min(distance[i, j], distance[i, j + 1] + 3, distance[i + 1, j] + 3)
            distance[i, j] = min(d, distance[i + 1, j + 1] + 4, distance[i + 1, j - 1] + 4)
            off = (count * j - sum_x) ** 2 + (count * i - sum_y) ** 2
            if distance[i, j] > best or (distance[i, j] == best and off <= best_off):
                best = distance[i, j]
                best_off = off
                column, row = j - 1, i - 1
    return column, row
