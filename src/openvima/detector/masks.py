"""Instance masks: from image pixels to the grid of a box, and back."""

import torch

from openvima.detector.roi_align import roi_align


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

    Bilinear interpolation is separable, hence two matrix products.

    Args:
        probabilities: Of the cells inside each box, shape (N, size, size).
        boxes: Shape (N, 4).
        height: Of the image, in pixels.
        width: Of the image, in pixels.

    Returns:
        Shape (N, height, width), bool.
    """
    rows = _interpolation(boxes[:, 1], boxes[:, 3], probabilities.shape[1], height)
    columns = _interpolation(boxes[:, 0], boxes[:, 2], probabilities.shape[2], width)
    return rows @ probabilities @ columns.transpose(1, 2) >= 0.5


def _interpolation(low: torch.Tensor, high: torch.Tensor, size: int, length: int) -> torch.Tensor:
    """Weight of each cell for each pixel along one axis, shape (N, length, size); zero outside the box."""
    pixels = torch.arange(length, device=low.device, dtype=low.dtype) + 0.5
    extent = (high - low).clamp(min=1e-6)[:, None]
    positions = (pixels - low[:, None]) / extent * size - 0.5  # in cells, 0 at the centre of the first
    cells = torch.arange(size, device=low.device, dtype=low.dtype)
    return (1 - (positions[..., None] - cells).abs()).clamp(min=0)
