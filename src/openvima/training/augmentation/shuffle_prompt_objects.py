"""Prompt augmentation: each prompt scene lists its objects in an order of its own.

Generated demonstrations list an object at the same position in all frames of a prompt, which tells what moved
without looking. Neither detectors nor VIMA-Bench's `follow_order` do.
"""

from dataclasses import replace

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode


def with_shuffled_prompt_objects(
    episode: PreprocessedEpisode, rng: np.random.Generator
) -> PreprocessedEpisode:
    """Permute the objects of each prompt image, independently."""
    counts = episode.prompt.objects_per_image.astype(np.int64)
    firsts = np.cumsum(counts) - counts
    rows = [first + rng.permutation(count) for first, count in zip(firsts, counts, strict=True)]
    objects = episode.prompt.objects.select(np.concatenate([np.zeros(0, np.int64), *rows]))
    return replace(episode, prompt=replace(episode.prompt, objects=objects))
