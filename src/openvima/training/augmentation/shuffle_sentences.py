"""Prompt augmentation: sentences that define novel words come in any order."""

import re

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.training.augmentation.prompt_images import DEFINITION, images_by_name, with_prompt

_SENTENCE_END = re.compile(r"(?<=\.) ")
_IS_COMPARISON = re.compile(r"\} is \w+ than \{")


def shuffled(episode: PreprocessedEpisode, rng: np.random.Generator) -> PreprocessedEpisode:
    """Shuffle definitions, comparisons ("{a} is kobar than {b}.") and the instruction.

    At least one of several comparisons is kept. The purpose of an image then follows from the words around it
    and not from its position. Other prompts are unchanged.
    """
    definitions, comparisons, instruction = [], [], []
    for sentence in _SENTENCE_END.split(episode.prompt.text):
        if _IS_COMPARISON.search(sentence):
            comparisons.append(sentence)
        elif sentence.startswith(DEFINITION.partition("{")[0]):
            definitions.append(sentence)
        else:
            instruction.append(sentence)
    if comparisons:
        kept = rng.permutation(len(comparisons))[: int(rng.integers(1, len(comparisons) + 1))]
        definitions += [comparisons[int(number)] for number in kept]
    if not definitions:
        return episode
    blocks = [*definitions, " ".join(instruction)]
    text = " ".join(blocks[int(number)] for number in rng.permutation(len(blocks)))
    return with_prompt(episode, text, images_by_name(episode.prompt))
