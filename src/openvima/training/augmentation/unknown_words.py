"""Prompt augmentation: words become the unknown token, so that it is trained."""

import re
from dataclasses import dataclass, replace

import numpy as np

from openvima.policies.tokenizer import UNKNOWN
from openvima.training.dataset import Example

_SLOT_OR_WORD = re.compile(rf"\{{\w+\}}|{UNKNOWN}|[^\W\d_]+(?:-[^\W\d_]+)*")


@dataclass(frozen=True, slots=True)
class UnknownWords:
    """Replaces words of prompts by the unknown token; images, numbers and punctuation stay.

    Args:
        prob: Probability for each word.
    """

    prob: float

    def __call__(self, example: Example, rng: np.random.Generator) -> Example:
        """Augment a demonstration."""
        if not self.prob:
            return example

        def masked(found: re.Match[str]) -> str:
            is_word = found[0][0] != "{"
            return UNKNOWN if is_word and rng.random() < self.prob else found[0]

        prompt = example.episode.prompt
        prompt = replace(prompt, text=_SLOT_OR_WORD.sub(masked, prompt.text))
        return replace(example, content=replace(example.episode, prompt=prompt))
