"""Mask R-CNN: from images to objects with boxes, masks and scores, and the losses to train it with."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.detector.backbone import Backbone
from openvima.detector.boxes import clip, decode_boxes, suppress
from openvima.detector.config import FIRST_STRIDE, DetectorConfig
from openvima.detector.heads import WEIGHTS, BoxHead, MaskHead, box_losses, mask_loss
from openvima.detector.masks import paste_masks
from openvima.detector.matching import match, subsample
from openvima.detector.proposals import ProposalNetwork, ScoredAnchors
from openvima.detector.roi_align import pyramid_align

OBJECT_OVERLAP = 0.5  # of proposals with the object that they show
POSITIVE_SHARE = 0.25  # of the proposals that the losses look at


@dataclass(frozen=True, slots=True, eq=False)
class Objects:
    """The objects of one image of H × W pixels.

    Args:
        boxes: Edges in pixels, shape (N, 4).
        masks: Which pixels show each, shape (N, H, W), bool.
        scores: Shape (N,), 0 to 1, the best first; ones for objects that are known.
    """

    boxes: torch.Tensor
    masks: torch.Tensor
    scores: torch.Tensor

    def to(self, device: torch.device) -> "Objects":
        """Return the objects on another device."""
        return Objects(self.boxes.to(device), self.masks.to(device), self.scores.to(device))


class MaskRCNN(nn.Module):
    """Finds objects in images.

    Two steps: a proposal network looks at every place of the pyramid of features and names boxes that may
    hold an object; two heads then look at each of these boxes, one telling objects from background and moving
    the edges, the other drawing the mask.

        image ─ backbone ─ levels ─┬─ proposals ─ boxes ─┐
                                   └────── RoIAlign ◄────┴─ box head ─ scores, edges ─ RoIAlign ─ mask head

    Args:
        config: All sizes.
    """

    pixel_mean: torch.Tensor
    pixel_std: torch.Tensor

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = Backbone(config.backbone)
        self.proposals = ProposalNetwork(config)
        self.box_head = BoxHead(config)
        self.mask_head = MaskHead(config)
        for name, values in (("pixel_mean", config.pixel_mean), ("pixel_std", config.pixel_std)):
            self.register_buffer(name, torch.tensor(values).view(3, 1, 1), persistent=False)

    @torch.no_grad()
    def forward(self, images: torch.Tensor) -> list[Objects]:
        """Find the objects of each image.

        Args:
            images: Shape (B, 3, H, W), uint8, red first.
        """
        height, width = images.shape[2:]
        prepared, scale, size = self._prepare(images)
        levels = self.backbone(prepared)
        proposals = self.proposals.propose(self.proposals(levels), height=size[0], width=size[1])
        found = []
        for number, boxes in enumerate(proposals):
            own = [level[number : number + 1] for level in levels]
            boxes, scores, kinds = self._best(own, boxes, size)
            shares = self._masks(own, boxes, kinds)
            boxes = clip(boxes / scale, height=height, width=width)
            masks = paste_masks(shares, boxes, height=height, width=width)
            found.append(Objects(boxes, masks, scores))
        return found

    def losses(
        self,
        images: torch.Tensor,
        objects: Sequence[Objects],
        *,
        sampled: int,
        generator: torch.Generator,
    ) -> dict[str, torch.Tensor]:
        """Return the losses of a batch by name; their sum is what to minimise.

        Args:
            images: Shape (B, 3, H, W), uint8, red first.
            objects: Those of each image.
            sampled: Proposals of an image that the heads learn from.
            generator: Draws anchors and proposals, on the processor.
        """
        prepared, scale, (height, width) = self._prepare(images)
        levels = self.backbone(prepared)
        scored: ScoredAnchors = self.proposals(levels)
        known = [own.boxes.to(prepared.dtype) * scale for own in objects]
        losses = self.proposals.losses(scored, known, generator)
        proposed = self.proposals.propose(scored, height=height, width=width)
        parts = [
            _shown(torch.cat([boxes, own]), own, sampled=sampled, generator=generator)
            for boxes, own in zip(proposed, known, strict=True)
        ]
        # Those that show an object come first, image after image; then the background.
        boxes = torch.cat([part.positive for part in parts] + [part.negative for part in parts])
        counts = [len(part.positive) for part in parts] + [len(part.negative) for part in parts]
        numbers = torch.arange(len(parts)).repeat(2).repeat_interleave(torch.tensor(counts)).to(boxes.device)
        kinds, deltas = self.box_head(self._cut(levels, boxes, numbers, self.config.box_size))
        wanted = torch.cat([own[part.objects] for own, part in zip(known, parts, strict=True)])
        losses |= box_losses(kinds, deltas, proposals=boxes, boxes=wanted)
        masks = torch.cat([own.masks[part.objects] for own, part in zip(objects, parts, strict=True)])
        positive = boxes[: len(wanted)]
        logits = self.mask_head(self._cut(levels, positive, numbers[: len(wanted)], self.config.mask_size))
        losses["mask"] = mask_loss(logits, proposals=positive / scale, masks=masks)
        return losses

    def _prepare(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, tuple[int, int]]:
        """Normalised and padded images; growth of the edges of boxes, (4,); the size without the padding."""
        config = self.config
        pixels = images.to(self.pixel_mean.dtype)
        if config.colours == "bgr":
            pixels = pixels.flip(1)
        before = pixels.shape[2:]
        height, width = prepared_size(config, *before)
        if (height, width) != before:
            # As Pillow does: large images are averaged, and colours stay whole numbers.
            pixels = F.interpolate(pixels, (height, width), mode="bilinear", antialias=True).round()
        scale = pixels.new_tensor([width / before[1], height / before[0]]).repeat(2)
        pixels = (pixels - self.pixel_mean) / self.pixel_std
        divisor = self.backbone.divisor
        return F.pad(pixels, (0, -width % divisor, 0, -height % divisor)), scale, (height, width)

    def _best(
        self, levels: Sequence[torch.Tensor], proposals: torch.Tensor, size: tuple[int, int]
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Boxes, scores, kinds of the objects of one image; only the likeliest kind of a proposal counts."""
        config = self.config
        numbers = torch.zeros(len(proposals), dtype=torch.int64, device=proposals.device)
        kinds, deltas = self.box_head(self._cut(levels, proposals, numbers, config.box_size))
        scores, best = kinds.softmax(dim=1)[:, :-1].max(dim=1)
        rows = (scores >= config.score).nonzero()[:, 0]
        boxes = decode_boxes(deltas[rows, best[rows]], proposals[rows], WEIGHTS)
        boxes = clip(boxes, height=size[0], width=size[1])
        rows, boxes = _solid(rows, boxes)
        kept = suppress(boxes, scores[rows], config.overlap)[: config.most]
        rows = rows[kept]
        return boxes[kept], scores[rows], best[rows]

    def _masks(
        self, levels: Sequence[torch.Tensor], boxes: torch.Tensor, kinds: torch.Tensor
    ) -> torch.Tensor:
        """How surely the cells inside the boxes of one image show the object, (N, 2 · size, 2 · size)."""
        numbers = torch.zeros(len(boxes), dtype=torch.int64, device=boxes.device)
        logits = self.mask_head(self._cut(levels, boxes, numbers, self.config.mask_size))
        return logits[torch.arange(len(boxes), device=boxes.device), kinds].sigmoid()

    def _cut(
        self, levels: Sequence[torch.Tensor], boxes: torch.Tensor, images: torch.Tensor, size: int
    ) -> torch.Tensor:
        config = self.config
        return pyramid_align(
            levels[: len(config.backbone.widths)],  # the extra level is for proposals alone
            boxes,
            images,
            size=size,
            samples=config.samples,
            first_stride=FIRST_STRIDE,
            canonical_size=config.canonical_size,
            canonical_level=config.canonical_level,
        )


def prepared_size(config: DetectorConfig, height: int, width: int) -> tuple[int, int]:
    """Return height and width at which a network looks at an image, in pixels; halves are rounded up."""
    if config.short_side is None:
        return height, width
    scale = min(config.short_side / min(height, width), config.long_side / max(height, width))
    return math.floor(height * scale + 0.5), math.floor(width * scale + 0.5)


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """Proposals of one image that the heads learn from: P of objects, with their numbers, and background."""

    positive: torch.Tensor
    negative: torch.Tensor
    objects: torch.Tensor


def _shown(
    proposals: torch.Tensor, objects: torch.Tensor, *, sampled: int, generator: torch.Generator
) -> _Shown:
    numbers, labels = match(proposals, objects, low=OBJECT_OVERLAP, high=OBJECT_OVERLAP)
    positive, negative = subsample(labels, count=sampled, positive_share=POSITIVE_SHARE, generator=generator)
    return _Shown(proposals[positive], proposals[negative], numbers[positive])


def _solid(rows: torch.Tensor, boxes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Leave out boxes without area."""
    solid = (boxes[:, 2:] > boxes[:, :2]).all(dim=1)
    return rows[solid], boxes[solid]
