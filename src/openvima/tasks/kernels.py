"""Numba kernels over the label raster; the calling modules check the arguments."""

import numpy as np

from openvima.compilation import njit


@njit
def list_free_centres(
    labels: np.ndarray,  # (R, C) int16, 0 where free
    side: int,
    run: np.ndarray,  # (C,) int32, scratch
    centres: np.ndarray,  # (R · C,) int32, gets the free centres in row-major order, as row · C + column
) -> int:
    """List cells around which a square window of `side` cells is free, and return their number.

    A window that reaches an occupied cell, the outermost ring of cells or past the raster is not free. For an
    even side the window has one cell more on the low side, as in the benchmark's erosion.

    One pass, whatever the side: `run` counts the free cells upwards in each column, `width` the neighbouring
    columns with a run of at least `side`. The last cell of a free window is reached last, so its centre lies
    behind the present cell.
    """
    num_rows, num_columns = labels.shape
    behind = (side - 1 - side // 2) * (num_columns + 1)  # from the last cell of a window to its centre
    run[:] = 0  # free cells above and including the present row, per column
    total = 0
    for row in range(1, num_rows - 1):
        width = 0
        for column in range(1, num_columns - 1):
            if labels[row, column] == 0:
                run[column] += 1
            else:
                run[column] = 0
            if run[column] >= side:
                width += 1
            else:
                width = 0
            if width >= side:
                centres[total] = row * num_columns + column - behind
                total += 1
    return total


@njit
def squared_depths(
    mask: np.ndarray,  # (H, W) bool, where the object is in a window that holds all of it
    vertical: np.ndarray,  # (H, W) int32, scratch
    depths: np.ndarray,  # (H, W) int32, gets the result
) -> None:
    """Squared distance, in cells, of each cell of one object to the nearest cell that is not of it.

    Cells outside of the window count as not of the object, and cells of others get 0.

    Source: exact distance transform in two passes, columns then rows (Felzenszwalb and Huttenlocher, 2012);
    the second is a plain search, which is fast enough at this size.
    """
    num_rows, num_columns = depths.shape
    far = num_rows + num_columns
    for column in range(num_columns):
        distance = 0
        for row in range(num_rows):
            distance = distance + 1 if mask[row, column] else 0
            vertical[row, column] = distance
        distance = 0
        for row in range(num_rows - 1, -1, -1):
            distance = distance + 1 if mask[row, column] else 0
            vertical[row, column] = min(vertical[row, column], distance)
    for row in range(num_rows):
        for column in range(num_columns):
            best = far * far
            for other in range(-1, num_columns + 1):
                height = vertical[row, other] if 0 <= other < num_columns else 0
                best = min(best, (other - column) * (other - column) + height * height)
            depths[row, column] = best
