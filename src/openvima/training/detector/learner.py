"""The learner of a detector: losses and checkpoints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from openvima.detector.checkpoint import load_weights, write_network
from openvima.detector.frames import Frame
from openvima.detector.network import Instances, MaskRCNN
from openvima.policies.naming import WEIGHTS_FILE
from openvima.training.learner import Learner


@dataclass(frozen=True, slots=True, eq=False)
class FrameBatch:
    """Frames of one size.

    Args:
        images: Shape (B, 3, H, W), uint8.
        objects: Those of each image.
        generator: Samples the anchors and proposals of the losses.
    """

    images: torch.Tensor
    objects: Sequence[Instances]
    generator: torch.Generator

    @staticmethod
    def of(frames: Sequence[Frame], generator: torch.Generator) -> "FrameBatch":
        """Stack frames into tensors."""
        images = torch.from_numpy(np.stack([frame.rgb for frame in frames]))
        objects = [
            Instances(
                torch.from_numpy(frame.boxes), torch.from_numpy(frame.masks), torch.ones(len(frame.boxes))
            )
            for frame in frames
        ]
        return FrameBatch(images, objects, generator)

    def to(self, device: torch.device) -> "FrameBatch":
        """Return the batch on another device; random numbers come from the CPU."""
        return FrameBatch(
            self.images.to(device), [objects.to(device) for objects in self.objects], self.generator
        )


class DetectorLearner(Learner):
    """A Mask R-CNN, trained on frames with known objects.

    Args:
        network: The network; it is trained in place.
        sampled: Proposals of a frame that the heads are trained on.
    """

    def __init__(self, network: MaskRCNN, *, sampled: int) -> None:
        super().__init__()
        self.network = network
        self._sampled = sampled

    def forward(self, batch: FrameBatch) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Return the sum of the losses, and each of them as "loss/NAME"."""
        losses = self.network.losses(
            batch.images, batch.objects, sampled=self._sampled, generator=batch.generator
        )
        parts = {f"loss/{name}": value.detach() for name, value in losses.items()}
        return torch.stack(list(losses.values())).sum(), parts

    def write(self, folder: Path, weights: Mapping[str, torch.Tensor]) -> None:
        """Write a checkpoint that `load_detector` takes."""
        prefix = "network."
        own = {name.removeprefix(prefix): tensor for name, tensor in weights.items()}
        write_network(self.network, folder, own)

    def read(self, folder: Path) -> None:
        """Load the weights of a checkpoint."""
        load_weights(self.network, folder / WEIGHTS_FILE)

    def description(self) -> dict[str, Any]:  # Any: plain YAML values
        """Return all sizes of the network."""
        return self.network.config.to_dict()
