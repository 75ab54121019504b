"""Demonstrations in memory as a network in training takes them."""

from collections.abc import Callable, Iterable

import numpy as np
import pytest
import torch

from openvima.data import Demonstration
from openvima.data.preprocessed import PreprocessedEpisode, number_images, preprocess
from openvima.policies.batch import Batch
from openvima.policies.processor import Processor
from openvima.training import TrainingConfig, train
from openvima.training.batches import Example, ExampleSource


def stack_images(episodes: list[PreprocessedEpisode]) -> tuple[list[Example], torch.Tensor]:
    """Examples that share a stack of images, and the stack."""
    images = [episode.images for episode in episodes]
    bases = np.cumsum([0, *map(len, images)])[:-1].tolist()
    stack = np.concatenate([np.zeros_like(images[0][:1]), *images])
    return [Example(*pair) for pair in zip(episodes, bases, strict=True)], torch.from_numpy(stack)


def examples_of(demos: Iterable[Demonstration], processor: Processor):
    """The same of demonstrations."""
    return stack_images([preprocess(demo, processor.input_kind) for demo in demos])


def source_of(demos: Iterable[Demonstration], processor: Processor) -> ExampleSource:
    """The same as if they had been read from an object cache."""
    return source_of_episodes([preprocess(demo, processor.input_kind) for demo in demos])


def source_of_episodes(episodes: list[PreprocessedEpisode]) -> ExampleSource:
    """Preprocessed demonstrations as if they had been read from an object cache."""
    counts = np.array([len(episode.images) for episode in episodes])
    lengths = np.array([[episode.num_steps, len(episode.objects)] for episode in episodes])
    return ExampleSource(episodes, np.arange(len(episodes)), np.cumsum(counts) - counts, lengths)


def collate_examples(processor: Processor, examples: Iterable[Example]) -> Batch:
    """A batch whose images are numbered as in the examples' stack."""
    examples = list(examples)
    return processor.collate(number_images([e.episode for e in examples], [e.base for e in examples]))


def rngs_of(examples: list[Example], seed: int = 0) -> list[np.random.Generator]:
    """A generator for each example."""
    return [np.random.default_rng([seed, number]) for number in range(len(examples))]


class Killed(BaseException):
    """Stands for a kill signal."""


def check_mixed_precision(network: torch.nn.Module, loss: Callable[[], torch.Tensor]) -> None:
    """A loss in mixed precision is nearly that in float32, and its gradients are finite."""
    with torch.autocast("cpu", torch.bfloat16):
        mixed = loss()
    torch.testing.assert_close(mixed.float(), loss(), rtol=0.05, atol=0.05)
    mixed.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


def train_until(config: TrainingConfig, step: int) -> None:
    """Train and be killed when so many steps have been begun; nothing is tidied up."""
    from openvima.training import loop, policy

    begun = 0

    class Trainer(loop.Trainer):
        def _step(self, *arguments):
            nonlocal begun
            begun += 1
            if begun > step:
                raise Killed
            return super()._step(*arguments)

    with pytest.MonkeyPatch.context() as patched, pytest.raises(Killed):
        patched.setattr(policy, "Trainer", Trainer)
        train(config)
