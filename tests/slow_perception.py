"""Slow, obvious twins of the perception kernels, by the definitions."""

import heapq

import numpy as np

CROP = 32


def crop_and_box(rgb: np.ndarray, shown: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The resized crop, as real numbers before rounding, and the box of the pixels where `shown` is true."""
    rows, columns = np.nonzero(shown)
    top, bottom, left, right = rows.min(), rows.max(), columns.min(), columns.max()
    cut = rgb[:, top : bottom + 1, left : right + 1].astype(float)
    _, height, width = cut.shape
    size = max(height, width)
    before_rows, before_columns = (size - height) // 2, (size - width) // 2
    square = np.zeros((3, size, size))
    square[:, before_rows : before_rows + height, before_columns : before_columns + width] = cut
    weights = shrinking(size) if size >= CROP else enlarging(size)
    crop = np.einsum("iy,cyx,jx->cij", weights, square, weights)
    return crop, np.array([(left + right) // 2, (top + bottom) // 2, bottom - top, right - left])


def shrinking(size: int) -> np.ndarray:
    """Share of each source pixel in each target pixel, shape (32, size)."""
    scale = size / CROP
    weights = np.zeros((CROP, size))
    for target in range(CROP):
        for source in range(size):
            common = min(source + 1, (target + 1) * scale) - max(source, target * scale)
            weights[target, source] = max(0.0, common) / scale
    return weights


def enlarging(size: int) -> np.ndarray:
    """Weights of the two source pixels whose border a target pixel crosses, or of the one that it is in."""
    weights = np.zeros((CROP, size))
    for target in range(CROP):
        source = min(target * size // CROP, size - 1)
        beyond = (target + 1) - (source + 1) * CROP / size  # of the target pixel, over the source's end
        share = max(0.0, beyond) if source + 1 < size else 0.0
        weights[target, source] += 1 - share
        weights[target, min(source + 1, size - 1)] += share
    return weights


def most_interior(shown: np.ndarray) -> tuple[int, int]:
    """Column and row of the pixel farthest from any pixel that is not shown, in 3-4 chamfer steps."""
    padded = np.pad(shown, 1)
    distance = np.where(padded, np.inf, 0.0)
    queue = [(0.0, int(r), int(c)) for r, c in zip(*np.nonzero(~padded), strict=True)]
    heapq.heapify(queue)
    while queue:
        far, row, column = heapq.heappop(queue)
        if far > distance[row, column]:
            continue
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                r, c = row + i, column + j
                inside = 0 <= r < padded.shape[0] and 0 <= c < padded.shape[1]
                step = 4 if i and j else 3
                if (i or j) and inside and far + step < distance[r, c]:
                    distance[r, c] = far + step
                    heapq.heappush(queue, (far + step, r, c))
    rows, columns = np.nonzero(shown)
    count = len(rows)
    candidates = [
        (
            -distance[r + 1, c + 1],
            (count * c - columns.sum()) ** 2 + (count * r - rows.sum()) ** 2,
            int(r),
            int(c),
        )
        for r, c in zip(rows, columns, strict=True)
    ]
    _, _, row, column = min(candidates)
    return column, row
