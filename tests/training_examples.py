"""Demonstrations in memory as a network in training takes them."""

from collections.abc import Iterable

import numpy as np

from openvima.data import Demonstration
from openvima.data.tokens.episode import tokens_of
from openvima.policies.inputs import Reader
from openvima.training.dataset import Example, stack_images, token_kind
from openvima.training.source import ExampleSource


def examples_of(demos: Iterable[Demonstration], reader: Reader):
    """Examples that share a stack of images, and the stack."""
    return stack_images([tokens_of(demo, token_kind(reader)) for demo in demos], reader)


def source_of(demos: Iterable[Demonstration], reader: Reader) -> ExampleSource:
    """The same as if they had come out of a token cache."""
    episodes = [tokens_of(demo, token_kind(reader)) for demo in demos]
    counts = np.array([len(episode.images) for episode in episodes])
    lengths = np.array([[len(episode.steps), len(episode.objects)] for episode in episodes])
    return ExampleSource(episodes, np.arange(len(episodes)), np.cumsum(counts) - counts, lengths)


def rngs_of(examples: list[Example], seed: int = 0) -> list[np.random.Generator]:
    """A generator for each example."""
    return [np.random.default_rng([seed, number]) for number in range(len(examples))]
