"""Anchor boxes of a feature pyramid."""

from collections.abc import Sequence
from functools import lru_cache

import torch

ASPECT_RATIOS = (0.5, 1.0, 2.0)  # height over width


def cell_anchors(size: float) -> torch.Tensor:
    """Return the anchors of one cell, centred on the origin.

    Args:
        size: Square root of their common area, in pixels.

    Returns:
        One anchor for each of `ASPECT_RATIOS`, shape (3, 4), float32.

    Example:
        >>> cell_anchors(8.0)[1]
        tensor([-4., -4.,  4.,  4.])
    """
    ratios = torch.tensor(ASPECT_RATIOS)
    widths = size / ratios.sqrt()
    halves = torch.stack([widths, widths * ratios], dim=1) / 2
    return torch.cat([-halves, halves], dim=1)


@lru_cache(maxsize=64)
def level_anchors(size: float, *, stride: int, height: int, width: int) -> torch.Tensor:
    """Return all anchors of one pyramid level; the tensor is shared between calls.

    Args:
        size: As for `cell_anchors`.
        stride: Of the level, in pixels; the first cell is centred on the image's upper left corner.
        height: Rows of cells.
        width: Columns of cells.

    Returns:
        Shape (height · width · 3, 4), float32, ordered by row, column and aspect ratio.
    """
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    shifts = torch.stack([columns, rows, columns, rows], dim=-1).view(-1, 1, 4) * stride
    return (shifts + cell_anchors(size)).view(-1, 4)


def pyramid_anchors(
    sizes: Sequence[float], shapes: Sequence[tuple[int, int]], *, first_stride: int
) -> list[torch.Tensor]:
    """Return the anchors of each level; strides double from level to level.

    Args:
        sizes: Anchor size of each level, as for `cell_anchors`.
        shapes: Rows and columns of each level.
        first_stride: Stride of the finest level.
    """
    return [
        level_anchors(size, stride=first_stride * 2**level, height=height, width=width)
        for level, (size, (height, width)) in enumerate(zip(sizes, shapes, strict=True))
    ]
