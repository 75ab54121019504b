"""What is said of each proposal: whether it is an object, where its edges are, and which pixels are its own.

Source: Mask R-CNN (He et al. 2017), section 3 and figure 4, right.
"""

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.boxes import encode_boxes
from openvima.detector.config import DetectorConfig
from openvima.detector.masks import cut_masks

WEIGHTS = (10.0, 10.0, 5.0, 5.0)  # of the coding of boxes


class BoxHead(nn.Module):
    """Kind and edges of what a proposal shows.

    Args:
        config: All sizes.
    """

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        width = config.backbone.pyramid_width * config.box_size**2
        hidden = []
        for out in config.box_widths:
            hidden.append(nn.Linear(width, out))
            width = out
        self.hidden = nn.ModuleList(hidden)
        self.kinds = nn.Linear(width, config.num_classes + 1)  # the last one is background
        self.deltas = nn.Linear(width, 4 * config.num_classes)
        for layer in self.hidden:
            nn.init.kaiming_uniform_(layer.weight, a=1)  # type: ignore[arg-type]  # all are linear
        nn.init.normal_(self.kinds.weight, std=0.01)
        nn.init.normal_(self.deltas.weight, std=0.001)

    def forward(self, cut: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Map features (R, C, size, size) to logits (R, classes + 1) and deltas (R, classes, 4)."""
        x = cut.flatten(1)
        for layer in self.hidden:
            x = F.relu(layer(x))
        return self.kinds(x), self.deltas(x).unflatten(1, (-1, 4))


class MaskHead(nn.Module):
    """Which pixels inside a box show the object.

    Args:
        config: All sizes.
    """

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        width, convs = config.backbone.pyramid_width, []
        for out in config.mask_widths:
            convs.append(nn.Conv2d(width, out, 3, padding=1))
            width = out
        self.convs = nn.ModuleList(convs)
        self.finer = nn.ConvTranspose2d(width, width, 2, stride=2)
        self.masks = nn.Conv2d(width, config.num_classes, 1)
        for layer in (*self.convs, self.finer):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")  # type: ignore[arg-type]  # convolutions
        nn.init.normal_(self.masks.weight, std=0.001)

    def forward(self, cut: torch.Tensor) -> torch.Tensor:
        """Map features (R, C, size, size) to logits (R, classes, 2 · size, 2 · size)."""
        for layer in self.convs:
            cut = F.relu(layer(cut))
        return self.masks(F.relu(self.finer(cut)))


def box_losses(
    kinds: torch.Tensor,
    deltas: torch.Tensor,
    *,
    proposals: torch.Tensor,
    boxes: torch.Tensor,
) -> dict[str, torch.Tensor]:
    """Losses of the box head; all objects are of kind 0.

    Args:
        kinds: Logits, shape (R, classes + 1).
        deltas: Shape (R, classes, 4).
        proposals: Shape (R, 4), those that show an object first.
        boxes: Edges of the objects that the first P proposals show, shape (P, 4).
    """
    background = kinds.shape[1] - 1
    wanted = torch.full((len(kinds),), background, device=kinds.device)
    wanted[: len(boxes)] = 0
    moved = encode_boxes(boxes, proposals[: len(boxes)], WEIGHTS)
    return {
        "kind": F.cross_entropy(kinds, wanted),
        "box": F.l1_loss(deltas[: len(boxes), 0], moved, reduction="sum") / max(1, len(kinds)),
    }


def mask_loss(logits: torch.Tensor, *, proposals: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
    """Loss of the mask head.

    Args:
        logits: Shape (P, classes, size, size); the first class counts.
        proposals: Shape (P, 4).
        masks: Pixels of the object that each shows, shape (P, H, W), bool.
    """
    if not len(logits):
        return logits.sum()
    wanted = cut_masks(masks, proposals, size=logits.shape[-1])
    return F.binary_cross_entropy_with_logits(logits[:, 0], wanted.to(logits.dtype))
