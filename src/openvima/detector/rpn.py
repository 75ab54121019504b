"""The region proposal network, which scores anchors and regresses them to objects.

Source: Faster R-CNN (Ren et al. 2015), section 3; one head is shared by all pyramid levels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.anchors import ASPECT_RATIOS, pyramid_anchors
from openvima.detector.boxes import decode_boxes, encode_boxes, nms
from openvima.detector.config import FIRST_STRIDE, DetectorConfig
from openvima.detector.matching import match, subsample

WEIGHTS = (1.0, 1.0, 1.0, 1.0)  # of the box regression
BACKGROUND_IOU = 0.3  # anchors below it are background
ANCHORS_PER_IMAGE, POSITIVE_FRACTION = 256, 0.5  # of the loss


@dataclass(frozen=True, slots=True, eq=False)
class AnchorPredictions:
    """Predictions of the region proposal network for the K anchors of each level.

    Args:
        anchors: Boxes of each level, shape (K, 4).
        objectness: Logits of each level, shape (B, K).
        deltas: Box regression of each level, shape (B, K, 4).
    """

    anchors: list[torch.Tensor]
    objectness: list[torch.Tensor]
    deltas: list[torch.Tensor]


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
        shapes = [(level.shape[2], level.shape[3]) for level in levels]
        anchors = pyramid_anchors(self.config.anchor_sizes, shapes, first_stride=FIRST_STRIDE)
        objectness, deltas = [], []
        # Both 1 × 1 convolutions as one matrix product, in the order of the anchors: (3 · 5, C)
        weight = _interleaved(self.objectness.weight, self.deltas.weight)
        bias = _interleaved(self.objectness.bias, self.deltas.bias)
        for level in levels:
            hidden = F.relu_(self.conv(level)).permute(0, 2, 3, 1)
            outputs = F.linear(hidden, weight, bias).reshape(len(level), -1, 5)  # (B, h · w · 3, 5)
            objectness.append(outputs[..., 0])
            deltas.append(outputs[..., 1:])
        device, dtype = levels[0].device, levels[0].dtype
        return AnchorPredictions([a.to(device, dtype) for a in anchors], objectness, deltas)

    @torch.no_grad()
    def propose(self, predictions: AnchorPredictions, *, height: int, width: int) -> list[torch.Tensor]:
        """Return the proposals of each image, shape (P, 4), by descending objectness; NMS acts per level."""
        config = self.config
        all_scores, all_deltas, all_anchors, groups = [], [], [], []
        levels = zip(predictions.anchors, predictions.objectness, predictions.deltas, strict=True)
        for level, (anchors, objectness, deltas) in enumerate(levels):
            scores, rows = objectness.topk(min(config.rpn_pre_nms_top_n, len(anchors)))
            all_scores.append(scores)
            all_deltas.append(deltas.gather(1, rows[..., None].expand(-1, -1, 4)))
            all_anchors.append(anchors[rows])
            groups += [level] * scores.shape[1]
        deltas, anchors = torch.cat(all_deltas, dim=1), torch.cat(all_anchors, dim=1)
        all_boxes = decode_boxes(deltas, anchors, WEIGHTS, height=height, width=width)
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
        anchors = torch.cat(predictions.anchors)
        all_logits, all_deltas = (
            torch.cat(predictions.objectness, dim=1),
            torch.cat(predictions.deltas, dim=1),
        )
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
                targets = encode_boxes(boxes[indices[positive]], anchors[positive], WEIGHTS)
                box_loss = box_loss + F.l1_loss(deltas[positive], targets, reduction="sum")
        count = ANCHORS_PER_IMAGE * len(objects)
        return {"rpn_objectness": objectness_loss / count, "rpn_box": box_loss / count}


def _interleaved(objectness: torch.Tensor | None, deltas: torch.Tensor | None) -> torch.Tensor:
    """Join parameters of both convolutions, anchor by anchor: shape (3 · 5, …) without the kernel's axes."""
    assert objectness is not None and deltas is not None  # both have a bias
    ratios = len(ASPECT_RATIOS)
    parts = objectness.view(ratios, 1, -1), deltas.view(ratios, 4, -1)
    joined = torch.cat(parts, dim=1).flatten(0, 1)
    return joined if objectness.ndim > 1 else joined[:, 0]
