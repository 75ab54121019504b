"""Boxes: intersection over union, regression, non-maximum suppression, anchors, and samples for a loss.

A box is (left, upper, right, lower) in pixels; pixel 0 covers 0 to 1.
"""

import math
from functools import lru_cache

import numpy as np
import torch

from openvima.detector.config import FIRST_STRIDE
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
    boxes: torch.Tensor, scores: torch.Tensor, iou_threshold: float, groups: torch.Tensor
) -> torch.Tensor:
    """Apply greedy non-maximum suppression; of equal scores the first wins. Boxes without area are dropped.

    Args:
        boxes: Shape (N, 4).
        scores: Shape (N,).
        iou_threshold: Largest intersection over union of two boxes that are kept.
        groups: Shape (N,), int64; boxes of different groups are kept together.

    Returns:
        Indices of the kept boxes by descending score, shape (K,), int64.
    """
    order = np.argsort(-scores.cpu().numpy(), kind="stable")
    kept = suppress(boxes.detach().cpu().numpy(), order, groups.cpu().numpy(), iou_threshold)
    return torch.from_numpy(order[kept]).to(boxes.device)


def _centres_and_sizes(boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    low, high = boxes[..., :2], boxes[..., 2:]
    return (low + high) / 2, high - low


ASPECT_RATIOS = (0.5, 1.0, 2.0)  # height over width


@lru_cache(maxsize=64)
def pyramid_anchors(
    sizes: tuple[float, ...], shapes: tuple[tuple[int, int], ...]
) -> tuple[torch.Tensor, ...]:
    """Return the anchors of each level; the tensors are shared between calls.

    Args:
        sizes: Anchor size of each level: the square root of the area of all its anchors, in pixels.
        shapes: Rows and columns of each level. The first has `FIRST_STRIDE`, and strides double from level
            to level. The first cell of each is centred on the image's upper left corner.

    Returns:
        Of each level, shape (rows · columns · 3, 4), float32, ordered by row, column and `ASPECT_RATIOS`.

    Example:
        >>> pyramid_anchors((8.0,), ((1, 1),))[0][1]
        tensor([-4., -4.,  4.,  4.])
    """
    ratios, levels = torch.tensor(ASPECT_RATIOS), []
    for level, (size, (height, width)) in enumerate(zip(sizes, shapes, strict=True)):
        widths = size / ratios.sqrt()
        halves = torch.stack([widths, widths * ratios], dim=1) / 2
        rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        centres = torch.stack([columns, rows], dim=-1).view(-1, 1, 2) * FIRST_STRIDE * 2**level
        levels.append(torch.cat([centres - halves, centres + halves], dim=-1).view(-1, 4))
    return tuple(levels)


FOREGROUND, BACKGROUND, IGNORED = 1, 0, -1  # labels of boxes


def match(
    boxes: torch.Tensor, objects: torch.Tensor, *, low: float, high: float, allow_low_quality: bool = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """Assign a ground-truth object to each box.

    Args:
        boxes: Anchors or proposals, shape (R, 4).
        objects: Ground-truth boxes, shape (N, 4); there may be none.
        low: Boxes whose best IoU is below are background.
        high: Boxes whose best IoU is at least that are foreground; those between are ignored.
        allow_low_quality: Also label the best boxes of each object as foreground, whatever their IoU.

    Returns:
        Index of the object with the largest IoU, shape (R,), int64, 0 without objects; and labels,
        shape (R,), int64: `FOREGROUND`, `BACKGROUND` or `IGNORED`.
    """
    if not len(objects):
        none = torch.zeros(len(boxes), dtype=torch.int64, device=boxes.device)
        return none, none.clone()
    iou = box_iou(boxes, objects)
    best, indices = iou.max(dim=1)
    labels = torch.full_like(indices, IGNORED)
    labels[best < low] = BACKGROUND
    labels[best >= high] = FOREGROUND
    if allow_low_quality:
        most = iou.max(dim=0).values
        labels[((iou == most) & (most > 0)).any(dim=1)] = FOREGROUND
    return indices, labels


def subsample(
    labels: torch.Tensor, *, count: int, positive_fraction: float, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Sample boxes for a loss.

    Args:
        labels: Shape (R,), as returned by `match`.
        count: Number of boxes; fewer if there are not as many.
        positive_fraction: Largest fraction of foreground boxes; the rest is background.
        generator: On the CPU, whatever the device of the labels.

    Returns:
        Indices of foreground boxes and of background boxes.
    """
    positive, negative = ((labels == label).nonzero()[:, 0] for label in (FOREGROUND, BACKGROUND))
    num_positive = min(len(positive), int(count * positive_fraction))
    num_negative = min(len(negative), count - num_positive)
    return _sample(positive, num_positive, generator), _sample(negative, num_negative, generator)


def _sample(indices: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
    return indices[torch.randperm(len(indices), generator=generator)[:count].to(indices.device)]
