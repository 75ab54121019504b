"""A trained network as a `Detector`: boxes, masks and scores from one image."""

from collections.abc import Sequence
from copy import deepcopy

import numpy as np
import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from openvima.detector.backbone import ConvNorm
from openvima.detector.detection import Detections
from openvima.detector.network import Instances, MaskRCNN
from openvima.errors import ShapeError
from openvima.policies.base import usable_device


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

    @torch.inference_mode()
    def detect(self, rgb: np.ndarray, view: str) -> Detections:
        """Detect the objects in an image.

        Args:
            rgb: Shape (3, H, W), uint8.
            view: "front" or "top"; not used.

        Raises:
            ShapeError: The image has another shape or dtype.
        """
        return self.detect_batch([rgb])[0]

    @torch.inference_mode()
    def detect_batch(self, frames: Sequence[np.ndarray]) -> list[Detections]:
        """Detect the objects in each of several images of equal size.

        Args:
            frames: Shape (3, H, W), uint8, each. Detections are the same, bit by bit, whatever the even
                number of images; those in a single image differ by rounding.

        Raises:
            ShapeError: An image has another shape or dtype.
        """
        for rgb in frames:
            if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[0] != 3:
                raise ShapeError(
                    f"the image is {rgb.dtype} {rgb.shape}; it must be uint8 of shape (3, H, W)."
                )
        images = torch.from_numpy(np.stack(frames)).to(self.device)
        # Networks that enlarge their images have large features.
        size = len(images) if self.network.config.min_size is None else 1
        return [to_detections(found) for part in images.split(size) for found in self.network(part)]


def to_detections(found: Instances) -> Detections:
    """Convert instances to arrays; boxes contain the pixels that they cover by at least half."""
    _, height, width = found.masks.shape
    edges = found.boxes.cpu().double().numpy()
    first = np.floor(edges[:, :2] + 0.5)
    last = np.floor(edges[:, 2:] + 0.5) - 1
    limit = np.array([width, height]) - 1
    first = np.clip(first, 0, limit)
    last = np.clip(np.maximum(last, first), 0, limit)
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
