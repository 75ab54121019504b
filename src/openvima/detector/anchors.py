"""Anchors: boxes of fixed sizes at every cell of every level, from which the proposals start."""

from collections.abc import Sequence

import torch

RATIOS = (0.5, 1.0, 2.0)  # height over width


def cell_anchors(size: float) -> torch.Tensor:
    """Return the anchors of one cell around the origin, in pixels.

    Args:
        size: Square root of the area that all of them have.

    Returns:
        One for each of `RATIOS`, shape (3, 4), float32.

    Example:
        >>> cell_anchors(8.0)[1]
        tensor([-4., -4.,  4.,  4.])
    """
    ratios = torch.tensor(RATIOS)
    widths = size / ratios.sqrt()
    halves = torch.stack([widths, widths * ratios], dim=1) / 2
    return torch.cat([-halves, halves], dim=1)


def level_anchors(size: float, *, stride: int, height: int, width: int) -> torch.Tensor:
    """Return all anchors of one level.

    Args:
        size: As for `cell_anchors`.
        stride: Pixels between cells; the first cell's anchors lie around the image's upper left corner.
        height: Rows of cells.
        width: Columns of cells.

    Returns:
        Row by row, cell by cell, ratio by ratio; shape (height · width · 3, 4), float32.
    """
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    shifts = torch.stack([columns, rows, columns, rows], dim=-1).view(-1, 1, 4) * stride
    return (shifts + cell_anchors(size)).view(-1, 4)


def pyramid_anchors(
    sizes: Sequence[float], shapes: Sequence[tuple[int, int]], *, first_stride: int
) -> list[torch.Tensor]:
    """Return the anchors of each level; strides double from level to level.

    Args:
        sizes: Of each level, as for `cell_anchors`.
        shapes: Rows and columns of cells of each level.
        first_stride: Pixels between cells of the first one.
    """
    return [
        level_anchors(size, stride=first_stride * 2**level, height=height, width=width)
        for level, (size, (height, width)) in enumerate(zip(sizes, shapes, strict=True))
    ]
