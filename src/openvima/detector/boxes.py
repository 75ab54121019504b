"""Box operations: intersection over union, box regression targets, non-maximum suppression.

A box is (left, upper, right, lower) in pixels; pixel 0 covers 0 to 1.
"""

import math

import numpy as np
import torch

from openvima.detector.kernels import decode, suppress

MAX_LOG_SCALE = math.log(1000 / 16)  # of one regression step, as in Detectron2; keeps exp from overflowing

Weights = tuple[float, float, float, float]


def box_area(boxes: torch.Tensor) -> torch.Tensor:
    """Return the areas of boxes (..., 4) in square pixels, shape (...)."""
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])


def box_iou(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return the intersection over union of boxes (N, 4) and (M, 4), shape (N, M); 0 for two empty boxes."""
    low = torch.maximum(first[:, None, :2], second[:, :2])
    high = torch.minimum(first[:, None, 2:], second[:, 2:])
    intersection = (high - low).clamp(min=0).prod(dim=2)
    union = box_area(first)[:, None] + box_area(second) - intersection
    return torch.where(intersection > 0, intersection / union, 0.0)


def clip_boxes(boxes: torch.Tensor, *, height: float, width: float) -> torch.Tensor:
    """Clip boxes (..., 4) to the image."""
    limits = boxes.new_tensor([width, height, width, height])
    return torch.minimum(boxes.clamp(min=0), limits)


def encode_boxes(boxes: torch.Tensor, references: torch.Tensor, weights: Weights) -> torch.Tensor:
    """Return the regression targets that move reference boxes to boxes.

    Args:
        boxes: Shape (..., 4); not empty.
        references: Anchors or proposals, shape (..., 4); not empty.
        weights: Scale of each of the four targets.

    Returns:
        Weighted deltas (dx, dy, log dw, log dh), shape (..., 4); shifts are relative to the reference's size.

    Source: R-CNN (Girshick et al. 2014), appendix C.
    """
    centres, sizes = _centres_and_sizes(boxes)
    from_centres, from_sizes = _centres_and_sizes(references)
    deltas = torch.cat([(centres - from_centres) / from_sizes, (sizes / from_sizes).log()], dim=-1)
    return deltas * deltas.new_tensor(weights)


def decode_boxes(
    deltas: torch.Tensor, references: torch.Tensor, weights: Weights, *, height: float, width: float
) -> torch.Tensor:
    """Invert `encode_boxes`, with the growth limited to `MAX_LOG_SCALE`, and clip; without gradients.

    Args:
        deltas: Shape (..., 4).
        references: Shape (..., 4).
        weights: As for `encode_boxes`.
        height: Of the image.
        width: Of the image.
    """
    boxes = torch.empty(deltas.shape, dtype=references.dtype)
    rows, anchors = (part.detach().cpu().reshape(-1, 4).numpy() for part in (deltas, references))
    limits = float(width), float(height)
    decode(rows, anchors, weights, MAX_LOG_SCALE, limits, boxes.view(-1, 4).numpy())
    return boxes.to(deltas.device)


def nms(
    boxes: torch.Tensor, scores: torch.Tensor, iou_threshold: float, groups: torch.Tensor | None = None
) -> torch.Tensor:
    """Apply greedy non-maximum suppression; of equal scores the first wins. Boxes without area are dropped.

    Args:
        boxes: Shape (N, 4).
        scores: Shape (N,).
        iou_threshold: Largest intersection over union of two boxes that are kept.
        groups: Shape (N,), int64; boxes of different groups are kept together. None is one group.

    Returns:
        Indices of the kept boxes by descending score, shape (K,), int64.
    """
    order = np.argsort(-scores.cpu().numpy(), kind="stable")
    groups = torch.zeros(len(order), dtype=torch.int64) if groups is None else groups
    kept = suppress(boxes.detach().cpu().numpy(), order, groups.cpu().numpy(), iou_threshold)
    return torch.from_numpy(order[kept]).to(boxes.device)


def _centres_and_sizes(boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    low, high = boxes[..., :2], boxes[..., 2:]
    return (low + high) / 2, high - low
