"""Demonstrations whose images share one stack."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from openvima.data.object_cache.episode import PreprocessedEpisode
from openvima.perception.preprocessing import IMAGE_SIZES
from openvima.policies.processor import Processor


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """One demonstration whose images are part of a stack.

    Args:
        episode: The demonstration.
        base: Images of the stack before its own: its image n has index `base + n` there, and 0 stays 0.
        row: Its number among all demonstrations.
        other: Another one, from which objects may be inserted.
    """

    episode: PreprocessedEpisode
    base: int = 0
    row: int = 0
    other: "Example | None" = None


def stack_images(
    episodes: Sequence[PreprocessedEpisode], processor: Processor
) -> tuple[list[Example], torch.Tensor]:
    """Put the images of some demonstrations into one stack, after a blank one.

    Returns:
        The demonstrations, and the stack, shape (K, 3, height, width), uint8.
    """
    size = IMAGE_SIZES[processor.input_kind]
    stack = np.concatenate([np.zeros((1, 3, *size), np.uint8), *(episode.images for episode in episodes)])
    bases = np.cumsum([0, *(len(episode.images) for episode in episodes)]).tolist()
    examples = [Example(episode, base) for episode, base in zip(episodes, bases[:-1], strict=True)]
    return examples, torch.from_numpy(stack)
