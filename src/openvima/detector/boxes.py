"""Boxes as tensors: overlap, coding relative to a reference box, and suppression of duplicates.

A box is left, upper, right and lower edge in pixels, and pixel 0 reaches from 0 to 1.
"""

import math

import torch

# A box grows at most by 1000 / 16 at once, as in the published Mask R-CNN; keeps exp from overflowing.
LARGEST_GROWTH = math.log(1000 / 16)

Weights = tuple[float, float, float, float]


def areas(boxes: torch.Tensor) -> torch.Tensor:
    """Return areas in square pixels of boxes (..., 4), shape (...)."""
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])


def overlaps(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
    """Return intersection over union of boxes (N, 4) and (M, 4), shape (N, M); 0 where both are empty."""
    low = torch.maximum(first[:, None, :2], second[:, :2])
    high = torch.minimum(first[:, None, 2:], second[:, 2:])
    shared = (high - low).clamp(min=0).prod(dim=2)
    union = areas(first)[:, None] + areas(second) - shared
    return torch.where(shared > 0, shared / union, 0.0)


def clip(boxes: torch.Tensor, *, height: float, width: float) -> torch.Tensor:
    """Cut boxes (..., 4) off at the image's border."""
    limits = boxes.new_tensor([width, height, width, height])
    return torch.minimum(boxes.clamp(min=0), limits)


def encode_boxes(boxes: torch.Tensor, references: torch.Tensor, weights: Weights) -> torch.Tensor:
    """Express boxes relative to reference boxes.

    Args:
        boxes: Shape (..., 4); not empty.
        references: Shape (..., 4); not empty.
        weights: Factors on the four numbers, which bring them to like size.

    Returns:
        Shift of the centre in widths and heights of the reference, and logarithms of the ratios of widths and
        heights, times the weights; shape (..., 4).

    Source: R-CNN (Girshick et al. 2014), appendix C.
    """
    centres, sizes = _centres_and_sizes(boxes)
    from_centres, from_sizes = _centres_and_sizes(references)
    deltas = torch.cat([(centres - from_centres) / from_sizes, (sizes / from_sizes).log()], dim=-1)
    return deltas * deltas.new_tensor(weights)


def decode_boxes(deltas: torch.Tensor, references: torch.Tensor, weights: Weights) -> torch.Tensor:
    """Undo `encode_boxes`, with the growth limited to `LARGEST_GROWTH`.

    Args:
        deltas: Shape (..., 4).
        references: Shape (..., 4), or one that broadcasts to it.
        weights: As for `encode_boxes`.
    """
    deltas = deltas / deltas.new_tensor(weights)
    from_centres, from_sizes = _centres_and_sizes(references)
    centres = from_centres + deltas[..., :2] * from_sizes
    halves = from_sizes * deltas[..., 2:].clamp(max=LARGEST_GROWTH).exp() / 2
    return torch.cat([centres - halves, centres + halves], dim=-1)


def suppress(boxes: torch.Tensor, scores: torch.Tensor, overlap: float) -> torch.Tensor:
    """Leave out boxes that overlap a better one which is itself kept.

    The better of two equal scores is the one that comes first. All pairs are compared at once: starting from
    all boxes, those are struck out that a kept one overlaps, until nothing changes. Each round settles at
    least the best box that is not settled yet, so this ends, and it ends where going through the boxes one by
    one does. A few rounds are enough in practice.

    Args:
        boxes: Shape (N, 4).
        scores: Shape (N,).
        overlap: Largest intersection over union of two boxes that are kept.

    Returns:
        Indices of the boxes that are kept, the best first, shape (K,), int64.
    """
    order = scores.argsort(descending=True, stable=True)
    boxes = boxes[order]
    beats = (overlaps(boxes, boxes) > overlap).triu(diagonal=1)  # row beats column
    kept = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
    while True:
        now = ~beats[kept].any(dim=0)
        if torch.equal(now, kept):
            return order[kept]
        kept = now


def _centres_and_sizes(boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    low, high = boxes[..., :2], boxes[..., 2:]
    return (low + high) / 2, high - low
