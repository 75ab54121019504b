"""The region proposal network: where in an image some object may be.

Source: Faster R-CNN (Ren et al. 2015), section 3, one head for all levels of a pyramid.
"""

from collections.abc import Sequence

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.anchors import RATIOS, pyramid_anchors
from openvima.detector.boxes import clip, decode_boxes, encode_boxes, suppress
from openvima.detector.config import FIRST_STRIDE, DetectorConfig
from openvima.detector.matching import match, subsample

WEIGHTS = (1.0, 1.0, 1.0, 1.0)  # of the coding of boxes
BACKGROUND_OVERLAP = 0.3  # anchors that overlap no object more than that show background
SAMPLED, POSITIVE_SHARE = 256, 0.5  # anchors of an image that the loss looks at


class ProposalNetwork(nn.Module):
    """Scores every anchor and moves it towards an object.

    Args:
        config: All sizes.
    """

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        width = config.backbone.pyramid_width
        self.conv = nn.Conv2d(width, width, 3, padding=1)
        self.scores = nn.Conv2d(width, len(RATIOS), 1)
        self.deltas = nn.Conv2d(width, 4 * len(RATIOS), 1)
        for layer in (self.conv, self.scores, self.deltas):
            nn.init.normal_(layer.weight, std=0.01)
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]  # these convolutions have one

    def forward(self, levels: Sequence[torch.Tensor]) -> "ScoredAnchors":
        """Score the anchors of all levels, (B, C, h, w) each."""
        shapes = [(level.shape[2], level.shape[3]) for level in levels]
        anchors = pyramid_anchors(self.config.anchor_sizes, shapes, first_stride=FIRST_STRIDE)
        scores, deltas = [], []
        for level in levels:
            hidden = F.relu(self.conv(level))
            scores.append(self.scores(hidden).permute(0, 2, 3, 1).flatten(1))  # (B, h · w · 3)
            # (B, 3 · 4, h, w) to (B, h · w · 3, 4), in the order of the anchors
            deltas.append(self.deltas(hidden).permute(0, 2, 3, 1).reshape(len(level), -1, 4))
        device, dtype = levels[0].device, levels[0].dtype
        return ScoredAnchors([a.to(device, dtype) for a in anchors], scores, deltas)

    @torch.no_grad()
    def propose(self, scored: "ScoredAnchors", *, height: int, width: int) -> list[torch.Tensor]:
        """Choose the best boxes of each image, shape (P, 4); duplicates within a level are left out."""
        return [
            self._propose(scored, image, height=height, width=width) for image in range(len(scored.scores[0]))
        ]

    def _propose(self, scored: "ScoredAnchors", image: int, *, height: int, width: int) -> torch.Tensor:
        config = self.config
        kept_boxes, kept_scores = [], []
        for anchors, scores, deltas in zip(scored.anchors, scored.scores, scored.deltas, strict=True):
            best, rows = scores[image].topk(min(config.candidates, len(anchors)))
            boxes = clip(
                decode_boxes(deltas[image, rows], anchors[rows], WEIGHTS), height=height, width=width
            )
            solid = (boxes[:, 2:] > boxes[:, :2]).all(dim=1)
            boxes, best = boxes[solid], best[solid]
            # Levels one by one: comparing the boxes of all at once takes twice as long.
            kept = suppress(boxes, best, config.proposal_overlap)
            kept_boxes.append(boxes[kept])
            kept_scores.append(best[kept])
        order = torch.cat(kept_scores).argsort(descending=True, stable=True)
        return torch.cat(kept_boxes)[order[: config.proposals]]

    def losses(
        self, scored: "ScoredAnchors", objects: Sequence[torch.Tensor], generator: torch.Generator
    ) -> dict[str, torch.Tensor]:
        """Losses of telling anchors on objects from background, and of moving the former.

        Args:
            scored: The anchors of B images.
            objects: Boxes of the objects of each image, shape (N, 4).
            generator: Draws the anchors that count.
        """
        anchors = torch.cat(scored.anchors)
        all_scores, all_deltas = torch.cat(scored.scores, dim=1), torch.cat(scored.deltas, dim=1)
        score_loss = delta_loss = all_scores.new_zeros(())
        for scores, deltas, boxes in zip(all_scores, all_deltas, objects, strict=True):
            numbers, labels = match(
                anchors, boxes, low=BACKGROUND_OVERLAP, high=self.config.anchor_overlap, every_object=True
            )
            positive, negative = subsample(
                labels, count=SAMPLED, positive_share=POSITIVE_SHARE, generator=generator
            )
            chosen = torch.cat([positive, negative])
            score_loss = score_loss + F.binary_cross_entropy_with_logits(
                scores[chosen], labels[chosen].to(scores.dtype), reduction="sum"
            )
            if len(positive):
                wanted = encode_boxes(boxes[numbers[positive]], anchors[positive], WEIGHTS)
                delta_loss = delta_loss + F.l1_loss(deltas[positive], wanted, reduction="sum")
        count = SAMPLED * len(objects)
        return {"proposal_score": score_loss / count, "proposal_box": delta_loss / count}


class ScoredAnchors:
    """What the proposal network says of each anchor; K a level.

    Args:
        anchors: Boxes of each level, shape (K, 4).
        scores: Logits of showing an object, shape (B, K).
        deltas: How to move them, shape (B, K, 4).
    """

    def __init__(
        self, anchors: list[torch.Tensor], scores: list[torch.Tensor], deltas: list[torch.Tensor]
    ) -> None:
        self.anchors, self.scores, self.deltas = anchors, scores, deltas
