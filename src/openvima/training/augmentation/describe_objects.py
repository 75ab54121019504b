"""Prompt augmentation: text descriptions in place of object images, at random.

"Put the {a} into the {b}."    "Put the red swirl letter A into the {b}."

Source: MIDAS (Li et al. 2023), fine-tuning for in-context learning. Its probability is not published.
"""

from dataclasses import dataclass, replace

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.tasks.prompts import synonyms, with_phrases
from openvima.training.augmentation.prompt_images import images_by_name, with_prompt
from openvima.training.dataset import Example

_FORMS = "all {x}. {x}. is a zup {x}"  # plural, articles and colon, which descriptions bring with them


@dataclass(frozen=True, slots=True)
class DescribeObjects:
    """Replaces object images of task prompts by texture and name of the object.

    Args:
        image_prob: Probability for each image.
        synonym_prob: Probability that a description names the object by an alias of the catalogue.
        prompt_prob: Probability for each demonstration that all its images are replaced.
    """

    image_prob: float
    synonym_prob: float = 0.0
    prompt_prob: float = 0.0

    @property
    def prob(self) -> float:
        """A probability that is 0 if nothing is ever replaced."""
        return max(self.image_prob, self.prompt_prob)

    def __call__(self, example: Example, rng: np.random.Generator) -> Example:
        """Augment a demonstration."""
        if not self.prob:
            return example
        prob = 1.0 if self.prompt_prob and rng.random() < self.prompt_prob else self.image_prob
        episode = example.episode
        if self.synonym_prob:
            episode = with_synonyms(episode, self.synonym_prob, rng)
        return replace(example, content=with_descriptions(episode, prob, rng))


def with_descriptions(
    episode: PreprocessedEpisode, prob: float, rng: np.random.Generator
) -> PreprocessedEpisode:
    """Replace some object images by their descriptions; images without one stay.

    Args:
        episode: The demonstration.
        prob: Probability for each image.
        rng: Draws the images.
    """
    names = [name for name in episode.prompt.image_names if name in episode.descriptions]
    chosen = [name for name, draw in zip(names, rng.random(len(names)), strict=True) if draw < prob]
    if not chosen:
        return episode
    text = with_phrases(episode.prompt.text, {name: episode.descriptions[name] for name in chosen})
    return with_prompt(episode, text, images_by_name(episode.prompt))


def with_synonyms(episode: PreprocessedEpisode, prob: float, rng: np.random.Generator) -> PreprocessedEpisode:
    """Replace the names in some descriptions by aliases; those of objects without any stay.

    Args:
        episode: The demonstration.
        prob: Probability for each description.
        rng: Draws descriptions and aliases.
    """
    said = dict(episode.descriptions)
    for name, draw, choice in zip(said, rng.random(len(said)), rng.random(len(said)), strict=True):
        if draw < prob and (others := synonyms(said[name])):
            said[name] = others[int(choice * len(others))]
    return replace(episode, descriptions=said)


def text_of(description: str) -> str:
    """Return a text with all words that a description brings into prompts: article and plural, too."""
    return with_phrases(_FORMS, {"x": description})
