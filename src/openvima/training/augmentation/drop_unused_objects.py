"""Scene augmentation of inverse dynamics: objects that the actions do not use are dropped."""

from dataclasses import dataclass, replace

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.training.dataset import Example


@dataclass(frozen=True, slots=True)
class DropUnusedObjects:
    """Drops unused objects from the observations, and others from the prompt frames.

    Args:
        prob: Probability of the first for each unused object, and of the second for each that is left; it
            needs the ids of the segmentation.
    """

    prob: float

    def __call__(self, example: Example, rng: np.random.Generator) -> Example:
        """Augment a demonstration."""
        if not self.prob:
            return example
        return replace(example, content=without_unused_objects(example.episode, self.prob, rng))


def without_unused_objects(
    episode: PreprocessedEpisode, prob: float, rng: np.random.Generator
) -> PreprocessedEpisode:
    """Drop unused objects from the observations, and others from the prompt frames."""
    ids = np.setdiff1d(episode.objects.ids, [episode.pick_ids, episode.place_ids])
    is_unobserved, is_unprompted = rng.random((2, len(ids))) < prob
    prompt = episode.prompt
    observed = ~np.isin(episode.objects.ids, ids[is_unobserved])
    prompted = ~np.isin(prompt.objects.ids, ids[is_unprompted & ~is_unobserved])
    return replace(
        episode,
        objects=episode.objects.select(observed),
        objects_per_step=_counted(episode.objects_per_step, observed),
        prompt=replace(
            prompt,
            objects=prompt.objects.select(prompted),
            objects_per_image=_counted(prompt.objects_per_image, prompted),
        ),
    )


def _counted(counts: np.ndarray, kept: np.ndarray) -> np.ndarray:
    """Count the kept rows of each group."""
    group = np.repeat(np.arange(len(counts)), counts)
    return np.bincount(group[kept], minlength=len(counts)).astype(counts.dtype)
