"""Box head and mask head.

Source: Mask R-CNN (He et al. 2017), section 3 and figure 4, right.
"""

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.boxes import encode_boxes
from openvima.detector.config import DetectorConfig
from openvima.detector.cpu_inference import is_cpu_inference
from openvima.detector.masks import crop_masks

WEIGHTS = (10.0, 10.0, 5.0, 5.0)  # of the box regression


class BoxHead(nn.Module):
    """Classifies proposals and refines their boxes.

    Args:
        config: Sizes of the detector.
    """

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        width = config.backbone.fpn_width * config.box_pool_size**2
        hidden = []
        for out in config.box_head_widths:
            hidden.append(nn.Linear(width, out))
            width = out
        self.hidden = nn.ModuleList(hidden)
        self.class_logits = nn.Linear(width, config.num_classes + 1)  # the last class is background
        self.deltas = nn.Linear(width, 4 * config.num_classes)
        for layer in self.hidden:
            nn.init.kaiming_uniform_(layer.weight, a=1)  # type: ignore[arg-type]  # all are linear
        nn.init.normal_(self.class_logits.weight, std=0.01)
        nn.init.normal_(self.deltas.weight, std=0.001)

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Map features (R, C, size, size) to logits (R, classes + 1) and deltas (R, classes, 4)."""
        x = features.flatten(1)
        for layer in self.hidden:
            x = F.relu_(layer(x))
        return self.class_logits(x), self.deltas(x).unflatten(1, (-1, 4))


class MaskHead(nn.Module):
    """Predicts the mask inside each box.

    Args:
        config: Sizes of the detector.
    """

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        width, convs = config.backbone.fpn_width, []
        for out in config.mask_head_widths:
            convs.append(nn.Conv2d(width, out, 3, padding=1))
            width = out
        self.convs = nn.ModuleList(convs)
        self.deconv = nn.ConvTranspose2d(width, width, 2, stride=2)
        self.mask_logits = nn.Conv2d(width, config.num_classes, 1)
        for layer in (*self.convs, self.deconv):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")  # type: ignore[arg-type]  # convolutions
        nn.init.normal_(self.mask_logits.weight, std=0.001)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Map features (R, C, size, size) to logits (R, classes, 2 · size, 2 · size)."""
        for layer in self.convs:
            features = F.relu_(layer(features))
        if is_cpu_inference(features):
            return self._upsampled(features)
        return self.mask_logits(F.relu_(self.deconv(features)))

    def _upsampled(self, features: torch.Tensor) -> torch.Tensor:
        """Apply the last two layers as matrix products, which take a third of the time on a CPU."""
        count, width, size, _ = features.shape
        kernel = self.deconv.weight.permute(0, 2, 3, 1).reshape(width, -1)  # (C, 2 · 2 · C)
        assert self.deconv.bias is not None  # it has one
        cells = F.relu_((features.permute(0, 2, 3, 1) @ kernel).view(-1, width).add_(self.deconv.bias))
        logits = F.linear(cells, self.mask_logits.weight.flatten(1), self.mask_logits.bias)
        logits = logits.view(count, size, size, 2, 2, logits.shape[1]).permute(0, 5, 1, 3, 2, 4)
        return logits.reshape(count, logits.shape[1], 2 * size, 2 * size)


def box_losses(
    logits: torch.Tensor, deltas: torch.Tensor, *, proposals: torch.Tensor, boxes: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Return the losses of the box head; all objects are of class 0.

    Args:
        logits: Class logits, shape (R, classes + 1).
        deltas: Shape (R, classes, 4).
        proposals: Shape (R, 4), the P foreground proposals first.
        boxes: Ground-truth boxes of the foreground proposals, shape (P, 4).
    """
    background = logits.shape[1] - 1
    classes = torch.full((len(logits),), background, device=logits.device)
    classes[: len(boxes)] = 0
    targets = encode_boxes(boxes, proposals[: len(boxes)], WEIGHTS)
    return {
        "class": F.cross_entropy(logits, classes),
        "box": F.l1_loss(deltas[: len(boxes), 0], targets, reduction="sum") / max(1, len(logits)),
    }


def mask_loss(logits: torch.Tensor, *, proposals: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
    """Return the loss of the mask head.

    Args:
        logits: Shape (P, classes, size, size); the first class counts.
        proposals: Shape (P, 4).
        masks: Ground-truth mask of each proposal, shape (P, H, W), bool.
    """
    if not len(logits):
        return logits.sum()
    targets = crop_masks(masks, proposals, size=logits.shape[-1])
    return F.binary_cross_entropy_with_logits(logits[:, 0], targets.to(logits.dtype))
