"""Assignment of ground-truth objects to boxes, and sampling of boxes for a loss."""

import torch

from openvima.detector.boxes import box_iou

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
