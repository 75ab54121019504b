"""RoIAlign: features of a pyramid resampled on a fixed grid inside boxes; masks in and out of such grids.

Inference on a CPU takes the Numba kernels.

Source: Mask R-CNN (He et al. 2017), section 3; with the half-pixel shift of later versions.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch.nn import functional as F

from openvima.detector.boxes import box_area
from openvima.detector.config import FIRST_STRIDE, DetectorConfig
from openvima.detector.kernels import align, paste


def roi_align(
    features: torch.Tensor,
    boxes: torch.Tensor,
    images: torch.Tensor,
    *,
    size: int,
    stride: float,
    sampling_ratio: int,
) -> torch.Tensor:
    """Average-pool features over the cells of a grid inside each box.

    Each cell averages `sampling_ratio` × `sampling_ratio` bilinear samples. Features are located at the
    centres of their pixels. Samples up to one pixel outside take the border value, those further out zero.

    Args:
        features: Shape (B, C, H, W).
        boxes: In image pixels, shape (R, 4).
        images: Index of each box's image, shape (R,), int64.
        size: Cells of the grid in each direction.
        stride: Image pixels per feature.
        sampling_ratio: Samples per cell in each direction; 0 adapts it to the size of the box, about one
            sample per feature.

    Returns:
        Shape (R, C, size, size).
    """
    boxes = boxes / stride - 0.5
    lows, extents = boxes[:, :2], boxes[:, 2:] - boxes[:, :2]
    counts = (extents / size).ceil().clamp(min=1).long()
    if sampling_ratio:
        counts = torch.full_like(counts, sampling_ratio)
    result = features.new_zeros(len(boxes), features.shape[1], size, size)
    for columns, rows in counts.unique(dim=0).tolist():  # boxes with equally many samples at once
        chosen = ((counts[:, 0] == columns) & (counts[:, 1] == rows)).nonzero()[:, 0]
        x, y = (
            _sample_points(lows[chosen, axis], extents[chosen, axis], size, count)
            for axis, count in enumerate((columns, rows))
        )
        result = result.index_put((chosen,), _pool(features, x, y, images[chosen]))
    return result


def pyramid_align(
    levels: Sequence[torch.Tensor],
    boxes: torch.Tensor,
    images: torch.Tensor,
    config: DetectorConfig,
    *,
    size: int,
) -> torch.Tensor:
    """Apply `roi_align` to each box on the pyramid level that fits its size.

    Args:
        levels: Features of each level, shape (B, C, H, W); strides double from level to level. An extra one
            is for proposals only.
        boxes: In image pixels, shape (R, 4).
        images: Index of each box's image, shape (R,), int64.
        config: Decides levels and sampling.
        size: Cells of the grid in each direction.

    Returns:
        Shape (R, C, size, size).
    """
    indices, sampling_ratio = box_levels(boxes, config), config.roi_sampling_ratio
    result = levels[0].new_zeros(len(boxes), levels[0].shape[1], size, size)
    is_cpu_inference = boxes.device.type == "cpu" and not torch.is_grad_enabled()
    for level, features in enumerate(levels[: len(config.backbone.widths)]):
        stride, chosen = FIRST_STRIDE * 2**level, (indices == level).nonzero()[:, 0]
        if is_cpu_inference:
            arrays = (each.numpy() for each in (boxes, images, indices))
            pixels = features.permute(0, 2, 3, 1).contiguous().numpy()
            align(pixels, *arrays, level, stride, sampling_ratio, result.numpy())
        elif len(chosen):
            pooled = roi_align(
                features,
                boxes[chosen],
                images[chosen],
                size=size,
                stride=stride,
                sampling_ratio=sampling_ratio,
            )
            result = result.index_put((chosen,), pooled)
    return result


def box_levels(boxes: torch.Tensor, config: DetectorConfig) -> torch.Tensor:
    """Return the level that fits each box (R, 4), shape (R,), int64.

    Source: Feature Pyramid Networks (Lin et al. 2017), equation 1.
    """
    sides = box_area(boxes).clamp(min=0).sqrt()
    levels = (config.canonical_level + (sides / config.canonical_size + 1e-8).log2()).floor()
    return levels.clamp(0, len(config.backbone.widths) - 1).long()


def _sample_points(low: torch.Tensor, extent: torch.Tensor, size: int, samples: int) -> torch.Tensor:
    """Sampling points of all cells along one axis, shape (R, size, samples)."""
    steps = (torch.arange(size * samples, device=low.device, dtype=low.dtype) + 0.5) / (size * samples)
    return (low[:, None] + extent[:, None] * steps).view(-1, size, samples)


def _neighbours(points: torch.Tensor, length: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices and weights of the two features beside each point of an axis, both of shape (..., 2)."""
    inside = (points >= -1) & (points <= length)
    points = points.clamp(0, length - 1)
    first = points.floor().clamp(max=max(length - 2, 0)).long()
    after = points - first
    indices = torch.stack([first, (first + 1).clamp(max=length - 1)], dim=-1)
    return indices, torch.stack([1 - after, after], dim=-1) * inside[..., None]


def _pool(features: torch.Tensor, x: torch.Tensor, y: torch.Tensor, images: torch.Tensor) -> torch.Tensor:
    """Average the features at the points x × y of each cell, shape (R, C, size, size)."""
    _, channels, height, width = features.shape
    num_boxes, size, _ = x.shape
    columns, x_weights = (part.flatten(2) for part in _neighbours(x, width))  # (R, size, 2 · samples)
    rows, y_weights = (part.flatten(2) for part in _neighbours(y, height))
    rows = rows + images[:, None, None] * height
    # A cell is a weighted sum of rows of the table of all features: (R, size, size, rows, columns).
    positions = rows[:, :, None, :, None] * width + columns[:, None, :, None, :]
    weights = y_weights[:, :, None, :, None] * x_weights[:, None, :, None, :]
    weights = weights / (x.shape[2] * y.shape[2])
    table = features.permute(0, 2, 3, 1).reshape(-1, channels)
    cells = num_boxes * size * size
    summed = F.embedding_bag(
        positions.reshape(cells, -1), table, per_sample_weights=weights.reshape(cells, -1), mode="sum"
    )
    return summed.view(num_boxes, size, size, channels).permute(0, 3, 1, 2)


def crop_masks(masks: torch.Tensor, boxes: torch.Tensor, *, size: int) -> torch.Tensor:
    """Sample masks on a grid inside their boxes.

    Args:
        masks: One for each box, shape (R, H, W), bool.
        boxes: Shape (R, 4).
        size: Cells of the grid in each direction.

    Returns:
        Cells that are at least half inside the mask, shape (R, size, size), bool.
    """
    indices = torch.arange(len(boxes), device=boxes.device)
    coverage = roi_align(
        masks[:, None].to(boxes.dtype), boxes, indices, size=size, stride=1, sampling_ratio=2
    )
    return coverage[:, 0] >= 0.5


def paste_masks(probabilities: torch.Tensor, boxes: torch.Tensor, *, height: int, width: int) -> torch.Tensor:
    """Resample mask probabilities at the pixels of an image and threshold them at 0.5.

    Bilinear interpolation between the centres of cells; outside of the box everything is zero.

    Args:
        probabilities: Of the cells inside each box, shape (N, size, size).
        boxes: Shape (N, 4).
        height: Of the image, in pixels.
        width: Of the image, in pixels.

    Returns:
        Shape (N, height, width), bool.
    """
    masks = np.zeros((len(boxes), height, width), np.bool_)
    paste(probabilities.cpu().numpy(), boxes.cpu().double().numpy(), masks)
    return torch.from_numpy(masks).to(boxes.device)
