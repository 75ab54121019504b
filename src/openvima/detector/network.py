"""Mask R-CNN: instances with boxes, masks and scores from images, the training losses, and detection."""

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F
from torch.nn.utils.fusion import fuse_conv_bn_eval

from openvima.detector.boxes import clip_boxes, decode_boxes, match, nms, subsample
from openvima.detector.config import FIRST_STRIDE, DetectorConfig
from openvima.detector.detection import Detections
from openvima.detector.layers import (
    BOX_WEIGHTS,
    AnchorPredictions,
    Backbone,
    BoxHead,
    ConvNorm,
    MaskHead,
    RegionProposalNetwork,
    box_losses,
    mask_loss,
)
from openvima.detector.roi_align import paste_masks, pyramid_align
from openvima.policies.base import usable_device
from openvima.policies.nn.layers import TensorRecord

FOREGROUND_IOU = 0.5  # proposals from it on are foreground
POSITIVE_FRACTION = 0.25  # of the proposals in the losses of the heads


@dataclass(frozen=True, slots=True, eq=False)
class Instances(TensorRecord):
    """The object instances of one image of H × W pixels, predicted or ground truth.

    Args:
        boxes: Shape (N, 4).
        masks: Shape (N, H, W), bool.
        scores: Shape (N,), 0 to 1, descending; ones for ground truth.
    """

    boxes: torch.Tensor
    masks: torch.Tensor
    scores: torch.Tensor


class MaskRCNN(nn.Module):
    """A two-stage instance segmentation network.

    The region proposal network (RPN) proposes boxes on every level of the feature pyramid. The box head
    classifies each proposal and refines its box; the mask head then segments the object inside.

        image ─ backbone ─ levels ─┬─ RPN ─ proposals ─┐
                                   └──── RoIAlign ◄────┴─ box head ─ scores, boxes ─ RoIAlign ─ mask head

    Args:
        config: Sizes of the detector.
    """

    pixel_mean: torch.Tensor
    pixel_std: torch.Tensor

    def __init__(self, config: DetectorConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = Backbone(config.backbone)
        self.rpn = RegionProposalNetwork(config)
        self.box_head = BoxHead(config)
        self.mask_head = MaskHead(config)
        for name in ("pixel_mean", "pixel_std"):
            self.register_buffer(name, torch.tensor(getattr(config, name)).view(3, 1, 1), persistent=False)

    @torch.no_grad()
    def forward(self, images: torch.Tensor) -> list[Instances]:
        """Detect the objects of each image.

        Args:
            images: Shape (B, 3, H, W), uint8, RGB.
        """
        config, (height, width) = self.config, images.shape[2:]
        inputs, scale, size = self._preprocess(images)
        levels = self.backbone(inputs)
        proposals = self.rpn.propose(self.rpn(levels), height=size[0], width=size[1])
        boxes, scores, classes, owners = self._detect_boxes(levels, proposals, size)
        logits = self.mask_head(pyramid_align(levels, boxes, owners, config, size=config.mask_pool_size))
        probabilities = logits[torch.arange(len(boxes), device=boxes.device), classes].sigmoid()
        counts = owners.bincount(minlength=len(images)).tolist()
        boxes = clip_boxes(boxes / scale, height=height, width=width)
        masks = paste_masks(probabilities, boxes, height=height, width=width)
        return [
            Instances(*own)
            for own in zip(*(each.split(counts) for each in (boxes, masks, scores)), strict=True)
        ]

    def losses(
        self, images: torch.Tensor, targets: Sequence[Instances], *, sampled: int, generator: torch.Generator
    ) -> dict[str, torch.Tensor]:
        """Return the losses of a batch by name; training minimises their sum.

        Args:
            images: Shape (B, 3, H, W), uint8, RGB.
            targets: Ground truth of each image.
            sampled: Proposals per image in the losses of the heads.
            generator: Samples anchors and proposals, on the CPU.
        """
        config, (inputs, scale, (height, width)) = self.config, self._preprocess(images)
        levels = self.backbone(inputs)
        predictions: AnchorPredictions = self.rpn(levels)
        true_boxes = [own.boxes.to(inputs.dtype) * scale for own in targets]
        losses = self.rpn.losses(predictions, true_boxes, generator)
        proposals = self.rpn.propose(predictions, height=height, width=width)
        foregrounds, backgrounds, matches = [], [], []
        for proposed, own in zip(proposals, true_boxes, strict=True):
            boxes = torch.cat([proposed, own])
            rows, labels = match(boxes, own, low=FOREGROUND_IOU, high=FOREGROUND_IOU)
            foreground, background = subsample(
                labels, count=sampled, positive_fraction=POSITIVE_FRACTION, generator=generator
            )
            foregrounds.append(boxes[foreground])
            backgrounds.append(boxes[background])
            matches.append(rows[foreground])
        # Foreground proposals come first, image after image; then the background.
        boxes = torch.cat([*foregrounds, *backgrounds])
        counts = torch.tensor([len(each) for each in (*foregrounds, *backgrounds)])
        indices = torch.arange(len(targets)).repeat(2).repeat_interleave(counts).to(boxes.device)
        pooled = pyramid_align(levels, boxes, indices, config, size=config.box_pool_size)
        logits, deltas = self.box_head(pooled)
        matched = torch.cat([own[rows] for own, rows in zip(true_boxes, matches, strict=True)])
        losses |= box_losses(logits, deltas, proposals=boxes, boxes=matched)
        masks = torch.cat([own.masks[rows] for own, rows in zip(targets, matches, strict=True)])
        boxes, indices = boxes[: len(matched)], indices[: len(matched)]
        pooled = pyramid_align(levels, boxes, indices, config, size=config.mask_pool_size)
        losses["mask"] = mask_loss(self.mask_head(pooled), proposals=boxes / scale, masks=masks)
        return losses

    def _preprocess(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, tuple[int, int]]:
        """Return resized, normalised and padded images, the scale of boxes (4,), and the unpadded size."""
        config = self.config
        pixels = images.flip(1) if config.channel_order == "bgr" else images
        before = pixels.shape[2:]
        height, width = resized_shape(config, *before)
        if (height, width) != before:
            # Antialiased and rounded, as Pillow does it.
            pixels = pixels.to(self.pixel_mean.dtype)
            pixels = F.interpolate(pixels, (height, width), mode="bilinear", antialias=True).round()
        scale = self.pixel_mean.new_tensor([width / before[1], height / before[0]]).repeat(2)
        divisor = FIRST_STRIDE * 2 ** (len(config.backbone.widths) - 1)  # of the coarsest level
        padding = (0, -width % divisor, 0, -height % divisor)
        inputs = F.pad((pixels - self.pixel_mean) / self.pixel_std, padding)
        return inputs, scale, (height, width)

    def _detect_boxes(
        self, levels: Sequence[torch.Tensor], proposals: list[torch.Tensor], size: tuple[int, int]
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return boxes, scores, classes and images' indices; each proposal counts for its best class only."""
        config, references = self.config, torch.cat(proposals)
        counts = torch.tensor([len(boxes) for boxes in proposals])
        owners = torch.arange(len(proposals)).repeat_interleave(counts).to(references.device)
        pooled = pyramid_align(levels, references, owners, config, size=config.box_pool_size)
        logits, deltas = self.box_head(pooled)
        scores, classes = logits.softmax(dim=1)[:, :-1].max(dim=1)
        rows = (scores >= config.score_threshold).nonzero()[:, 0]
        deltas = deltas[rows, classes[rows]]
        boxes = decode_boxes(deltas, references[rows], BOX_WEIGHTS, height=size[0], width=size[1])
        kept = nms(boxes, scores[rows], config.nms_iou, owners[rows])
        # `kept` are places in `rows`, by descending score over all images; each image takes its best.
        of_images = (kept[owners[rows[kept]] == image] for image in range(len(proposals)))
        kept = torch.cat([own[: config.max_detections] for own in of_images])
        rows = rows[kept]
        return boxes[kept], scores[rows], classes[rows], owners[rows]


def resized_shape(config: DetectorConfig, height: int, width: int) -> tuple[int, int]:
    """Return the height and width to which an image is resized; halves are rounded up."""
    if config.min_size is None:
        return height, width
    scale = min(config.min_size / min(height, width), config.max_size / max(height, width))
    return math.floor(height * scale + 0.5), math.floor(width * scale + 0.5)


class FrameDetector:
    """Detects the objects of frames by a Mask R-CNN.

    Images are processed in pairs or several pairs, whose detections do not depend on the batch.

    Args:
        network: The network; it is copied, with batch normalisation fused into the convolutions.
        device: Such as "cpu" or "cuda".

    Raises:
        PolicyError: The device is not available.
    """

    def __init__(self, network: MaskRCNN, *, device: torch.device | str = "cpu") -> None:
        self.device = usable_device(device)
        # Channels last takes a quarter of the time on a CPU.
        network = fuse_batch_norm(network).to(self.device)
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def detect(self, rgb: np.ndarray, view: str) -> Detections:
        """Detect the objects in an image.

        Args:
            rgb: Shape (3, H, W), uint8.
            view: "front" or "top"; not used.
        """
        return self.detect_batch([rgb])[0]

    @torch.inference_mode()
    def detect_batch(self, frames: Sequence[np.ndarray]) -> list[Detections]:
        """Detect the objects in each of several images of equal size.

        Args:
            frames: Shape (3, H, W), uint8, each. Detections are the same, bit by bit, whatever the even
                number of images; those in a single image differ by rounding.
        """
        images = torch.from_numpy(np.stack(frames)).to(self.device)
        # Networks that enlarge their images have large features.
        size = len(images) if self.network.config.min_size is None else 1
        return [to_detections(found) for part in images.split(size) for found in self.network(part)]


def to_detections(found: Instances) -> Detections:
    """Convert instances to arrays; boxes contain the pixels that they cover by at least half."""
    _, height, width = found.masks.shape
    edges, limit = np.floor(found.boxes.cpu().double().numpy() + 0.5), np.array([width, height]) - 1
    first = edges[:, :2].clip(0, limit)
    last = np.maximum(edges[:, 2:] - 1, first).clip(0, limit)
    boxes = np.concatenate([first, last], axis=1).astype(np.int64)
    return Detections(boxes, found.masks.cpu().numpy(), found.scores.cpu().double().numpy())


def fuse_batch_norm(network: MaskRCNN) -> MaskRCNN:
    """Return a copy for inference with batch normalisation fused into the convolutions."""
    copy = deepcopy(network).eval()
    for module in copy.modules():
        if isinstance(module, ConvNorm) and isinstance(module.norm, nn.BatchNorm2d):
            module.conv = fuse_conv_bn_eval(module.conv, module.norm)
            module.norm = nn.Identity()
    return copy.requires_grad_(False)
