"""Several preprocessed demonstrations, their tables joined: what a batch is made of."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from openvima.data.object_cache.episode import FalsePositives, PreprocessedEpisode
from openvima.perception.preprocessing import ObjectTable, PreprocessedPrompts


@dataclass(frozen=True, slots=True, eq=False)
class EpisodeBatch:
    """B demonstrations of T steps together. Fields are those of `PreprocessedEpisode`, one after the other.

    Args:
        tasks: Names of the tasks.
        seeds: Numbers of the episodes.
        end_effectors: Shape (B,), int64.
        num_steps: Steps of each demonstration, shape (B,), int64.
        prompts: The prompts.
        objects: Visible objects of all observations.
        objects_per_step: Number of them, shape (T,), int16.
        pick_ids: Shape (T,), int16.
        place_ids: Shape (T,), int16.
        false_positives: Of all steps.
        actions: Shape (T, 12), float32.
        images: Images of each demonstration, (K, 3, height, width), uint8.
        num_images: Number of them, shape (B,), int64.
        image_offsets: Images before those of each demonstration, in one stack of all after a blank image,
            shape (B,), int64.
    """

    tasks: Sequence[str]
    seeds: Sequence[int]
    end_effectors: np.ndarray
    num_steps: np.ndarray
    prompts: PreprocessedPrompts
    objects: ObjectTable
    objects_per_step: np.ndarray
    pick_ids: np.ndarray
    place_ids: np.ndarray
    false_positives: FalsePositives
    actions: np.ndarray
    images: Iterable[np.ndarray]
    num_images: np.ndarray
    image_offsets: np.ndarray

    @staticmethod
    def of(
        episodes: Sequence[PreprocessedEpisode], image_offsets: Sequence[int] | None = None
    ) -> "EpisodeBatch":
        """Join demonstrations.

        Args:
            episodes: The demonstrations.
            image_offsets: As above, where a larger stack holds their images; None stacks theirs alone.
        """
        counts = np.array([len(episode.images) for episode in episodes], np.int64)
        false_positives = [episode.false_positives for episode in episodes]
        return EpisodeBatch(
            [episode.task for episode in episodes],
            [episode.seed for episode in episodes],
            np.array([episode.end_effector for episode in episodes], np.int64),
            np.array([episode.num_steps for episode in episodes], np.int64),
            PreprocessedPrompts.of([episode.prompt for episode in episodes]),
            ObjectTable.concatenate([episode.objects for episode in episodes]),
            np.concatenate([episode.objects_per_step for episode in episodes]),
            np.concatenate([episode.pick_ids for episode in episodes]),
            np.concatenate([episode.place_ids for episode in episodes]),
            FalsePositives(
                np.concatenate([each.crop_index for each in false_positives]),
                np.concatenate([each.boxes for each in false_positives]),
            ),
            np.concatenate([episode.actions for episode in episodes]),
            [episode.images for episode in episodes],
            counts,
            np.cumsum(counts) - counts if image_offsets is None else np.array(image_offsets, np.int64),
        )
