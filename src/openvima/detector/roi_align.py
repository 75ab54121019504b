"""RoIAlign: what a pyramid of features holds inside boxes, on a grid of fixed size.

Source: Mask R-CNN (He et al. 2017), section 3; with the half-pixel shift that later versions have.
"""

from collections.abc import Sequence

import torch
from torch.nn import functional as F


def roi_align(
    features: torch.Tensor,
    boxes: torch.Tensor,
    images: torch.Tensor,
    *,
    size: int,
    stride: float,
    samples: int,
) -> torch.Tensor:
    """Average features over the cells of a grid laid into each box.

    In each cell `samples` × `samples` points are read by bilinear interpolation. Features are known at the
    centres of their pixels. A point at most one pixel outside reads the border, one further out zero.

    Args:
        features: Shape (B, C, H, W).
        boxes: Edges in pixels of the image, shape (R, 4).
        images: Which image each box belongs to, shape (R,), int64.
        size: Cells of the grid in each direction.
        stride: Pixels of the image for one of the features.
        samples: Points of a cell in each direction; 0 takes as many as a cell is features high and wide,
            rounded up.

    Returns:
        Shape (R, C, size, size).
    """
    boxes = boxes / stride - 0.5
    lows, extents = boxes[:, :2], boxes[:, 2:] - boxes[:, :2]
    if samples and len(boxes):
        x, y = (_points(lows[:, axis], extents[:, axis], size, samples) for axis in (0, 1))
        return _read(features, x, y, images)
    counts = (extents / size).ceil().clamp(min=1).long()
    result = features.new_zeros(len(boxes), features.shape[1], size, size)
    for columns, rows in counts.unique(dim=0).tolist():  # boxes with equally many points at once
        chosen = ((counts[:, 0] == columns) & (counts[:, 1] == rows)).nonzero()[:, 0]
        x = _points(lows[chosen, 0], extents[chosen, 0], size, columns)
        y = _points(lows[chosen, 1], extents[chosen, 1], size, rows)
        result = result.index_put((chosen,), _read(features, x, y, images[chosen]))
    return result


def pyramid_align(
    levels: Sequence[torch.Tensor],
    boxes: torch.Tensor,
    images: torch.Tensor,
    *,
    size: int,
    samples: int,
    first_stride: int,
    canonical_size: float,
    canonical_level: int,
) -> torch.Tensor:
    """Cut each box out of the level that fits its size; see `roi_align`.

    Args:
        levels: Features of each level, shape (B, C, H, W); strides double from level to level.
        boxes: Edges in pixels of the image, shape (R, 4).
        images: Which image each box belongs to, shape (R,), int64.
        size: Cells of the grid in each direction.
        samples: Points of a cell in each direction; 0 as for `roi_align`.
        first_stride: Pixels of the image for a feature of the first level.
        canonical_size: Square root of the area of boxes that are cut out of `canonical_level`.
        canonical_level: Number of that level.

    Returns:
        Shape (R, C, size, size).
    """
    numbers = box_levels(boxes, len(levels), canonical_size=canonical_size, canonical_level=canonical_level)
    result = levels[0].new_zeros(len(boxes), levels[0].shape[1], size, size)
    for number, features in enumerate(levels):
        chosen = (numbers == number).nonzero()[:, 0]
        if len(chosen):
            stride = first_stride * 2**number
            cut = roi_align(
                features, boxes[chosen], images[chosen], size=size, stride=stride, samples=samples
            )
            result = result.index_put((chosen,), cut)
    return result


def box_levels(
    boxes: torch.Tensor, num_levels: int, *, canonical_size: float, canonical_level: int
) -> torch.Tensor:
    """Return the number of the level that fits each box (R, 4), shape (R,), int64.

    Source: Feature Pyramid Networks (Lin et al. 2017), equation 1.
    """
    sides = ((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])).clamp(min=0).sqrt()
    numbers = (canonical_level + (sides / canonical_size + 1e-8).log2()).floor()
    return numbers.clamp(0, num_levels - 1).long()


def _points(low: torch.Tensor, extent: torch.Tensor, size: int, samples: int) -> torch.Tensor:
    """Where the points of all cells lie along one axis, shape (R, size, samples)."""
    steps = (torch.arange(size * samples, device=low.device, dtype=low.dtype) + 0.5) / (size * samples)
    return (low[:, None] + extent[:, None] * steps).view(-1, size, samples)


def _neighbours(points: torch.Tensor, length: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The two features beside each point of an axis, and their weights; both shape (..., 2)."""
    inside = (points >= -1) & (points <= length)
    points = points.clamp(0, length - 1)
    first = points.floor().clamp(max=max(length - 2, 0)).long()
    after = points - first
    numbers = torch.stack([first, (first + 1).clamp(max=length - 1)], dim=-1)
    return numbers, torch.stack([1 - after, after], dim=-1) * inside[..., None]


def _read(features: torch.Tensor, x: torch.Tensor, y: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    """Average the features at points x × y of each cell, shape (R, C, size, size)."""
    _, channels, height, width = features.shape
    num_boxes, size, _ = x.shape
    columns, x_weights = (part.flatten(2) for part in _neighbours(x, width))  # (R, size, 2 · samples)
    rows, y_weights = (part.flatten(2) for part in _neighbours(y, height))
    rows = rows + images[:, None, None] * height
    # A cell is a weighted sum of rows of the table of all features: (R, size, size, rows, columns).
    places = rows[:, :, None, :, None] * width + columns[:, None, :, None, :]
    weights = y_weights[:, :, None, :, None] * x_weights[:, None, :, None, :]
    weights = weights / (x.shape[2] * y.shape[2])
    table = features.permute(0, 2, 3, 1).reshape(-1, channels)
    cells = num_boxes * size * size
    summed = F.embedding_bag(
        places.reshape(cells, -1), table, per_sample_weights=weights.reshape(cells, -1), mode="sum"
    )
    return summed.view(num_boxes, size, size, channels).permute(0, 3, 1, 2)
