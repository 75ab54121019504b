"""Per-demonstration prompt and scene augmentation: the list of transforms, in the order of their draws."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.training.augmentation.describe_objects import DescribeObjects
from openvima.training.augmentation.distractor_insertion import with_distractors
from openvima.training.augmentation.drop_unused_objects import DropUnusedObjects
from openvima.training.augmentation.inverse_dynamics import with_motion_prompt
from openvima.training.augmentation.paraphrase import paraphrased
from openvima.training.augmentation.rename_objects import renamed
from openvima.training.augmentation.shuffle_prompt_objects import with_shuffled_prompt_objects
from openvima.training.augmentation.shuffle_sentences import shuffled
from openvima.training.augmentation.unknown_words import UnknownWords
from openvima.training.config import AugmentationConfig
from openvima.training.dataset import Example

Transform: TypeAlias = Callable[[Example, np.random.Generator], Example]


@dataclass(frozen=True, slots=True)
class Randomly:
    """Augments a fraction of the demonstrations.

    Args:
        prob: Probability per demonstration.
        augment: What happens to these.
    """

    prob: float
    augment: Callable[[PreprocessedEpisode, np.random.Generator], PreprocessedEpisode]

    def __call__(self, example: Example, rng: np.random.Generator) -> Example:
        """Augment a demonstration, or leave it as it is."""
        if not self.prob or rng.random() >= self.prob:
            return example
        return replace(example, content=self.augment(example.episode, rng))


@dataclass(frozen=True, slots=True)
class DemonstrationAugmentation:
    """Transforms of demonstrations, which have either an inverse-dynamics prompt or that of their task.

    Args:
        inverse_dynamics_prob: Probability of the inverse-dynamics prompt.
        of_inverse_dynamics: Transforms of demonstrations with that prompt.
        of_tasks: Transforms of those with the prompt of their task.
    """

    inverse_dynamics_prob: float = 0.0
    of_inverse_dynamics: tuple[Transform, ...] = ()
    of_tasks: tuple[Transform, ...] = (with_distractors,)

    def __call__(self, example: Example, rng: np.random.Generator | None) -> Example:
        """Augment a demonstration; without a generator, as in validation, only what is certain happens."""
        prob = self.inverse_dynamics_prob
        is_inverse = prob == 1 or (rng is not None and prob > 0 and rng.random() < prob)
        if is_inverse:
            example = replace(example, content=with_motion_prompt(example.episode))
        if rng is not None:
            for transform in self.of_inverse_dynamics if is_inverse else self.of_tasks:
                example = transform(example, rng)
        return example


NO_AUGMENTATION = DemonstrationAugmentation()


def demonstration_augmentation(config: AugmentationConfig) -> DemonstrationAugmentation:
    """Return the transforms that the settings ask for."""
    shuffle_prompt_objects = Randomly(config.shuffle_prompt_objects_prob, with_shuffled_prompt_objects)
    return DemonstrationAugmentation(
        config.inverse_dynamics_prob,
        of_inverse_dynamics=(DropUnusedObjects(config.drop_unused_objects_prob), shuffle_prompt_objects),
        of_tasks=(
            with_distractors,  # acts where the loader supplies another demonstration
            Randomly(config.paraphrase_prob, paraphrased),  # before others change the text
            Randomly(config.rename_objects_prob, renamed),
            Randomly(config.shuffle_sentences_prob, shuffled),
            # after those that look for images
            DescribeObjects(config.text_description_prob, config.synonym_prob, config.text_prompt_prob),
            UnknownWords(config.unknown_word_prob),
            shuffle_prompt_objects,
        ),
    )
