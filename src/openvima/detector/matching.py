"""Which object each box is to learn, and which boxes a loss looks at."""

import torch

from openvima.detector.boxes import overlaps

BACKGROUND, IGNORED = 0, -1  # labels of boxes that match no object, and of those that nearly do


def match(
    boxes: torch.Tensor, objects: torch.Tensor, *, low: float, high: float, every_object: bool = False
) -> tuple[torch.Tensor, torch.Tensor]:
    """Assign an object to each box.

    Args:
        boxes: Shape (R, 4).
        objects: Boxes of the objects of the image, shape (N, 4); there may be none.
        low: Boxes whose best overlap is below show background.
        high: Boxes whose best overlap is at least that show the object; those between are ignored.
        every_object: Let the best boxes of each object show it, too, however little they overlap it.

    Returns:
        Number of the object that a box overlaps most, shape (R,), int64, 0 if there is none; and labels,
        shape (R,), int64: 1, `BACKGROUND` or `IGNORED`.
    """
    if not len(objects):
        none = torch.zeros(len(boxes), dtype=torch.int64, device=boxes.device)
        return none, none.clone()
    shared = overlaps(boxes, objects)
    best, numbers = shared.max(dim=1)
    labels = torch.full_like(numbers, IGNORED)
    labels[best < low] = BACKGROUND
    labels[best >= high] = 1
    if every_object:
        most = shared.max(dim=0).values
        labels[((shared == most) & (most > 0)).any(dim=1)] = 1
    return numbers, labels


def subsample(
    labels: torch.Tensor, *, count: int, positive_share: float, generator: torch.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw boxes for a loss.

    Args:
        labels: Shape (R,), as `match` gives them.
        count: How many; fewer if there are not as many.
        positive_share: At most so many of `count` show an object; the rest is background.
        generator: On the processor, whatever the device of the labels.

    Returns:
        Indices of those that show an object, and of those that do not.
    """
    positive, negative = (labels == 1).nonzero()[:, 0], (labels == BACKGROUND).nonzero()[:, 0]
    num_positive = min(len(positive), int(count * positive_share))
    num_negative = min(len(negative), count - num_positive)
    return _drawn(positive, num_positive, generator), _drawn(negative, num_negative, generator)


def _drawn(indices: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
    return indices[torch.randperm(len(indices), generator=generator)[:count].to(indices.device)]
