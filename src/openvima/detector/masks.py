"""Masks: from the grid inside a box to the pixels of an image, and back."""

import torch

from openvima.detector.roi_align import roi_align


def cut_masks(masks: torch.Tensor, boxes: torch.Tensor, *, size: int) -> torch.Tensor:
    """See masks on a grid laid into boxes.

    Args:
        masks: One a box, shape (R, H, W), bool.
        boxes: Edges in pixels, shape (R, 4).
        size: Cells of the grid in each direction.

    Returns:
        Which cells lie in the mask for the most part, shape (R, size, size), bool.
    """
    numbers = torch.arange(len(boxes), device=boxes.device)
    shares = roi_align(masks[:, None].to(boxes.dtype), boxes, numbers, size=size, stride=1, samples=2)
    return shares[:, 0] >= 0.5


def paste_masks(shares: torch.Tensor, boxes: torch.Tensor, *, height: int, width: int) -> torch.Tensor:
    """Read masks at the pixels of an image, by bilinear interpolation between the centres of their cells.

    Interpolation along both axes at once is interpolation along one after the other, which makes it two
    products of matrices.

    Args:
        shares: How surely each cell lies in the mask, shape (N, size, size), 0 to 1.
        boxes: Edges in pixels, shape (N, 4).
        height: Pixels of the image.
        width: Pixels of the image.

    Returns:
        Whether each pixel's centre is more likely inside than not, shape (N, height, width), bool.
    """
    rows = _readings(boxes[:, 1], boxes[:, 3], shares.shape[1], height)
    columns = _readings(boxes[:, 0], boxes[:, 2], shares.shape[2], width)
    return rows @ shares @ columns.transpose(1, 2) >= 0.5


def _readings(low: torch.Tensor, high: torch.Tensor, size: int, length: int) -> torch.Tensor:
    """Weight of each cell in each pixel along one axis, shape (N, length, size); zero outside the box."""
    pixels = torch.arange(length, device=low.device, dtype=low.dtype) + 0.5
    extent = (high - low).clamp(min=1e-6)[:, None]
    places = (pixels - low[:, None]) / extent * size - 0.5  # in cells, 0 at the centre of the first
    cells = torch.arange(size, device=low.device, dtype=low.dtype)
    return (1 - (places[..., None] - cells).abs()).clamp(min=0)
