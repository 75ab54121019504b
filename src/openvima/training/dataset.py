"""Batches of demonstrations as a network of the family takes them.

Shape suffixes: B batch, T steps, N objects in view, V views, C components of an action.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from openvima.data.object_cache.episode import PreprocessedEpisode
from openvima.perception.preprocessing import IMAGE_SIZES, InputKind
from openvima.policies.heads.base import ActionTargets
from openvima.policies.inputs import HistoryBatch, PromptBatch, Reader


@dataclass(frozen=True, slots=True, eq=False)
class FalsePositiveBatch:
    """The false detections of a batch, see `FalsePositives`, padded.

    Args:
        crop_index: Indices of the crops, shape (B, T, 2).
        boxes: Boxes in pixels, shape (B, T, 2, 4).
        points: Table points under their centres, shape (B, T, 2, 2), metres.
    """

    crop_index: np.ndarray
    boxes: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One demonstration whose images are part of a stack.

    Args:
        episode: The demonstration.
        base: Images of the stack before its own: its image n has index `base + n` there, and 0 stays 0.
        row: Its number among all demonstrations.
        other: Another one, from which objects may be borrowed.
    """

    episode: PreprocessedEpisode
    base: int = 0
    row: int = 0
    other: "Example | None" = None


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """Several demonstrations, padded.

    Args:
        prompts: What the robot was told.
        history: What it saw.
        targets: What it did.
        false_positives: A false detection for each step and view.
        images: What the numbers of images count through, shape (K, 3, height, width), uint8; None where that
            is a stack of all demonstrations.
    """

    prompts: PromptBatch
    history: HistoryBatch
    targets: ActionTargets
    false_positives: FalsePositiveBatch
    images: torch.Tensor | None = None

    def to(self, device: torch.device | str) -> "Batch":
        """Return the batch on another device, without the false detections: they have been put in."""
        return replace(
            self,
            prompts=self.prompts.to(device),
            history=self.history.to(device),
            targets=self.targets.to(device),
            images=None if self.images is None else self.images.to(device, non_blocking=True),
        )


def input_kind(reader: Reader) -> InputKind:
    """Return what a network's images show: objects, or whole frames."""
    return "frames" if reader.layout == "frames" else "objects"


def stack_images(
    episodes: Sequence[PreprocessedEpisode], reader: Reader
) -> tuple[list[Example], torch.Tensor]:
    """Put the images of some demonstrations into one stack, behind a black one.

    Returns:
        The demonstrations, and the stack, shape (K, 3, height, width), uint8.
    """
    size = IMAGE_SIZES[input_kind(reader)]
    stack = np.concatenate([np.zeros((1, 3, *size), np.uint8), *(episode.images for episode in episodes)])
    bases = np.cumsum([0, *(len(episode.images) for episode in episodes)]).tolist()
    examples = [Example(episode, base) for episode, base in zip(episodes, bases[:-1], strict=True)]
    return examples, torch.from_numpy(stack)
