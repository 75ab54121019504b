"""Prompt augmentation: another phrasing of the task's prompt, such as "Turn the {a} by 30 degrees."."""

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.errors import UnknownTaskError
from openvima.tasks.paraphrasing import rephrased, training_paraphrases
from openvima.tasks.registry import task_spec
from openvima.training.augmentation.prompt_images import images_by_name, with_prompt


def paraphrased(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Put a paraphrase in place of a prompt; tasks without any, and prompts of other forms, are unchanged.

    Args:
        episode: The demonstration.
        rng: Draws the paraphrase.
    """
    phrasings = training_paraphrases().get(episode.task)
    if not phrasings:
        return episode
    try:
        template = task_spec(episode.task).template
    except UnknownTaskError:  # demonstrations of a task that is not installed here
        return episode
    text = rephrased(episode.prompt.text, template, phrasings[int(rng.integers(len(phrasings)))])
    return episode if text is None else with_prompt(episode, text, images_by_name(episode.prompt))
