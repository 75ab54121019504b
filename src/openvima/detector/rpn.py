"""The region proposal network, which scores anchors and regresses them to objects.

Source: Faster R-CNN (Ren et al. 2015), section 3; one head is shared by all pyramid levels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.anchors import ASPECT_RATIOS, pyramid_anchors
from openvima.detector.boxes import clip_boxes, decode_boxes, encode_boxes, is_solid, nms
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
        for level in levels:
            hidden = F.relu(self.conv(level))
            objectness.append(self.objectness(hidden).permute(0, 2, 3, 1).flatten(1))  # (B, h · w · 3)
            # (B, 3 · 4, h, w) to (B, h · w · 3, 4), in the order of the anchors
            deltas.append(self.deltas(hidden).permute(0, 2, 3, 1).reshape(len(level), -1, 4))
        device, dtype = levels[0].device, levels[0].dtype
        return AnchorPredictions([a.to(device, dtype) for a in anchors], objectness, deltas)

    @torch.no_grad()
    def propose(self, predictions: AnchorPredictions, *, height: int, width: int) -> list[torch.Tensor]:
        """Return the proposals of each image, shape (P, 4), by descending objectness; NMS acts per level."""
        return [
            self._propose(predictions, image, height=height, width=width)
            for image in range(len(predictions.objectness[0]))
        ]

    def _propose(
        self, predictions: AnchorPredictions, image: int, *, height: int, width: int
    ) -> torch.Tensor:
        config = self.config
        kept_boxes, kept_scores = [], []
        levels = zip(predictions.anchors, predictions.objectness, predictions.deltas, strict=True)
        for anchors, objectness, deltas in levels:
            scores, rows = objectness[image].topk(min(config.rpn_pre_nms_top_n, len(anchors)))
            boxes = decode_boxes(deltas[image, rows], anchors[rows], WEIGHTS)
            boxes = clip_boxes(boxes, height=height, width=width)
            solid = is_solid(boxes)
            boxes, scores = boxes[solid], scores[solid]
            # Per level: comparing the boxes of all levels at once takes twice as long.
            kept = nms(boxes, scores, config.rpn_nms_iou)
            kept_boxes.append(boxes[kept])
            kept_scores.append(scores[kept])
        order = torch.cat(kept_scores).argsort(descending=True, stable=True)
        return torch.cat(kept_boxes)[order[: config.rpn_post_nms_top_n]]

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
