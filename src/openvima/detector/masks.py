"""Instance masks: from image pixels to the grid of a box, and back."""

import numpy as np
import torch

from openvima.detector.kernels import paste
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
