"""Layers of Mask R-CNN: ResNet with a feature pyramid (FPN), region proposals (RPN), box and mask head.

Sources: Deep Residual Learning (He et al. 2016); Feature Pyramid Networks (Lin et al. 2017); Faster R-CNN
(Ren et al. 2015), section 3; Mask R-CNN (He et al. 2017), section 3 and figure 4, right.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.boxes import (
    ASPECT_RATIOS,
    decode_boxes,
    encode_boxes,
    match,
    nms,
    pyramid_anchors,
    subsample,
)
from openvima.detector.config import BackboneConfig, DetectorConfig
from openvima.detector.roi_align import crop_masks


class ConvNorm(nn.Module):
    """A convolution without bias, followed by batch normalisation.

    Args:
        inputs: Input channels.
        outputs: Output channels.
        kernel: Kernel size.
        stride: Stride.
    """

    def __init__(self, inputs: int, outputs: int, *, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False)
        self.norm: nn.Module = nn.BatchNorm2d(outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        return self.norm(self.conv(x))


class ResidualBlock(nn.Module):
    """Convolutions with a shortcut.

    Args:
        inputs: Input channels.
        outputs: Output channels.
        stride: Stride of the block.
        config: Decides the kind of block.
    """

    def __init__(self, inputs: int, outputs: int, *, stride: int, config: BackboneConfig) -> None:
        super().__init__()
        if config.block == "basic":
            layers = [(inputs, outputs, 3, stride), (outputs, outputs, 3, 1)]
        else:
            inner = outputs // 4
            first, second = (stride, 1) if config.stride_in_1x1 else (1, stride)
            layers = [(inputs, inner, 1, first), (inner, inner, 3, second), (inner, outputs, 1, 1)]
        self.layers = nn.ModuleList(ConvNorm(a, b, kernel=kernel, stride=s) for a, b, kernel, s in layers)
        self.shortcut = None
        if inputs != outputs or stride != 1:
            self.shortcut = ConvNorm(inputs, outputs, kernel=1, stride=stride)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Map (B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        residual = x if self.shortcut is None else self.shortcut(x)
        for index, layer in enumerate(self.layers):
            x = layer(x if index == 0 else F.relu_(x))
        return F.relu_(x.add_(residual))


class Backbone(nn.Module):
    """A ResNet whose stages feed an FPN: features at strides 4, 8, 16, …, with equally many channels.

        image ─ stem ─ stage ─ stage ─ stage ─ …     each halves the resolution
                         │       │       │           lateral 1 × 1 convolutions
                        P2 ◄─── P3 ◄─── P4 ◄─ …      upsampled and added; (─► extra level by max pooling)

    Args:
        config: Sizes of the backbone.
    """

    def __init__(self, config: BackboneConfig) -> None:
        super().__init__()
        self.frozen_batch_norm = config.frozen_batch_norm
        self.extra_level = config.extra_level
        self.stem = ConvNorm(3, config.stem_width, kernel=config.stem_kernel, stride=2)
        stages, inputs = [], config.stem_width
        for stage, (depth, width) in enumerate(zip(config.depths, config.widths, strict=True)):
            blocks = []
            for block in range(depth):
                stride = 2 if stage and not block else 1
                blocks.append(ResidualBlock(inputs, width, stride=stride, config=config))
                inputs = width
            stages.append(nn.Sequential(*blocks))
        self.stages = nn.ModuleList(stages)
        out = config.fpn_width
        self.lateral = nn.ModuleList(nn.Conv2d(width, out, 1) for width in config.widths)
        self.smooth = nn.ModuleList(nn.Conv2d(out, out, 3, padding=1) for _ in config.widths)
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_uniform_(module.weight, a=1)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def train(self, mode: bool = True) -> "Backbone":
        """Set the mode; frozen batch normalisation stays in evaluation mode."""
        super().train(mode)
        if self.frozen_batch_norm:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    def forward(self, images: torch.Tensor) -> list[torch.Tensor]:
        """Map images (B, 3, H, W) to the pyramid levels, finest first, each (B, C, h, w)."""
        x = F.max_pool2d(F.relu_(self.stem(images)), kernel_size=3, stride=2, padding=1)
        laterals = []
        for stage, lateral in zip(self.stages, self.lateral, strict=True):
            x = stage(x)
            laterals.append(lateral(x))
        merged = laterals[-1]
        levels = [self.smooth[-1](merged)]
        for lateral, smooth in zip(reversed(laterals[:-1]), reversed(self.smooth[:-1]), strict=True):
            merged = F.interpolate(merged, scale_factor=2.0, mode="nearest").add_(lateral)
            levels.insert(0, smooth(merged))
        if self.extra_level:
            levels.append(F.max_pool2d(levels[-1], kernel_size=1, stride=2))
        return levels


PROPOSAL_WEIGHTS = (1.0, 1.0, 1.0, 1.0)  # of the box regression
BACKGROUND_IOU = 0.3  # anchors below it are background
ANCHORS_PER_IMAGE, POSITIVE_FRACTION = 256, 0.5  # of the loss


# Of each level: K anchors, (K, 4), logits of their objectness, (B, K), and deltas of their boxes, (B, K, 4).
AnchorPredictions = Sequence[tuple[torch.Tensor, torch.Tensor, torch.Tensor]]


class RegionProposalNetwork(nn.Module):
    """Predicts objectness and box regression of every anchor, and proposes the best boxes.

    Args:
        config: Sizes of the detector.
    """

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        width = config.backbone.fpn_width
        self.conv = nn.Conv2d(width, width, 3, padding=1)
        self.objectness = nn.Conv2d(width, len(ASPECT_RATIOS), 1)
        self.deltas = nn.Conv2d(width, 4 * len(ASPECT_RATIOS), 1)
        for layer in (self.conv, self.objectness, self.deltas):
            nn.init.normal_(layer.weight, std=0.01)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]  # these convolutions have one

    def forward(self, levels: Sequence[torch.Tensor]) -> AnchorPredictions:
        """Predict from the pyramid levels, (B, C, h, w) each."""
        shapes = tuple((level.shape[2], level.shape[3]) for level in levels)
        anchors, ratios = pyramid_anchors(self.config.anchor_sizes, shapes), len(ASPECT_RATIOS)
        # Both 1 × 1 convolutions as one matrix product, in the order of the anchors: (3 · 5, C)
        weight, bias = (
            torch.cat([own.view(ratios, 1, -1), deltas.view(ratios, 4, -1)], dim=1).flatten(0, 1)
            for own, deltas in zip(self.objectness.parameters(), self.deltas.parameters(), strict=True)
        )
        predictions = []
        for level, own in zip(levels, anchors, strict=True):
            hidden = F.relu_(self.conv(level)).permute(0, 2, 3, 1)
            outputs = F.linear(hidden, weight, bias.flatten()).reshape(len(level), -1, 5)
            predictions.append((own.to(level), outputs[..., 0], outputs[..., 1:]))
        return predictions

    @torch.no_grad()
    def propose(self, predictions: AnchorPredictions, *, height: int, width: int) -> list[torch.Tensor]:
        """Return the proposals of each image, shape (P, 4), by descending objectness; NMS acts per level."""
        config = self.config
        all_scores, all_deltas, all_anchors, groups = [], [], [], []
        # The best of each level first, then all levels of an image at once: suppression compares boxes of a
        # level alone (`groups`), and its order is that of the scores over all levels.
        for level, (anchors, objectness, deltas) in enumerate(predictions):
            scores, rows = objectness.topk(min(config.rpn_pre_nms_top_n, len(anchors)))
            all_scores.append(scores)
            all_deltas.append(deltas.gather(1, rows[..., None].expand(-1, -1, 4)))
            all_anchors.append(anchors[rows])
            groups += [level] * scores.shape[1]
        deltas, anchors = torch.cat(all_deltas, dim=1), torch.cat(all_anchors, dim=1)
        all_boxes = decode_boxes(deltas, anchors, PROPOSAL_WEIGHTS, height=height, width=width)
        return [
            boxes[nms(boxes, scores, config.rpn_nms_iou, torch.tensor(groups))[: config.rpn_post_nms_top_n]]
            for boxes, scores in zip(all_boxes, torch.cat(all_scores, dim=1), strict=True)
        ]

    def losses(
        self, predictions: AnchorPredictions, objects: Sequence[torch.Tensor], generator: torch.Generator
    ) -> dict[str, torch.Tensor]:
        """Return the objectness loss and the box regression loss.

        Args:
            predictions: For B images.
            objects: Ground-truth boxes of each image, shape (N, 4).
            generator: Samples the anchors of the loss.
        """
        of_levels, *outputs = zip(*predictions, strict=True)
        anchors = torch.cat(of_levels)
        all_logits, all_deltas = (torch.cat(each, dim=1) for each in outputs)
        objectness_loss = box_loss = all_logits.new_zeros(())
        for logits, deltas, boxes in zip(all_logits, all_deltas, objects, strict=True):
            indices, labels = match(
                anchors,
                boxes,
                low=BACKGROUND_IOU,
                high=self.config.rpn_foreground_iou,
                allow_low_quality=True,
            )
            positive, negative = subsample(
                labels, count=ANCHORS_PER_IMAGE, positive_fraction=POSITIVE_FRACTION, generator=generator
            )
            sampled = torch.cat([positive, negative])
            objectness_loss = objectness_loss + F.binary_cross_entropy_with_logits(
                logits[sampled], labels[sampled].to(logits.dtype), reduction="sum"
            )
            if len(positive):
                targets = encode_boxes(boxes[indices[positive]], anchors[positive], PROPOSAL_WEIGHTS)
                box_loss = box_loss + F.l1_loss(deltas[positive], targets, reduction="sum")
        count = ANCHORS_PER_IMAGE * len(objects)
        return {"rpn_objectness": objectness_loss / count, "rpn_box": box_loss / count}


BOX_WEIGHTS = (10.0, 10.0, 5.0, 5.0)  # of the box regression


class BoxHead(nn.Module):
    """Classifies proposals and refines their boxes.

    Args:
        config: Sizes of the detector.
    """

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        widths = (config.backbone.fpn_width * config.box_pool_size**2, *config.box_head_widths)
        self.hidden = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))
        self.class_logits = nn.Linear(widths[-1], config.num_classes + 1)  # the last class is background
        self.deltas = nn.Linear(widths[-1], 4 * config.num_classes)
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
        widths = (config.backbone.fpn_width, *config.mask_head_widths)
        self.convs = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairwise(widths))
        self.deconv = nn.ConvTranspose2d(widths[-1], widths[-1], 2, stride=2)
        self.mask_logits = nn.Conv2d(widths[-1], config.num_classes, 1)
        for layer in (*self.convs, self.deconv):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")  # type: ignore[arg-type]  # convolutions
        nn.init.normal_(self.mask_logits.weight, std=0.001)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Map features (R, C, size, size) to logits (R, classes, 2 · size, 2 · size)."""
        for layer in self.convs:
            features = F.relu_(layer(features))
        return self.mask_logits(F.relu_(self.deconv(features)))


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
    targets = encode_boxes(boxes, proposals[: len(boxes)], BOX_WEIGHTS)
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
