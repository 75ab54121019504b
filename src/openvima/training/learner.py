"""`Learner`, the trained module: it makes batches of demonstrations, and computes a loss."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from openvima.data.preprocessed import number_images
from openvima.errors import ConfigError, InputFileError
from openvima.perception.preprocessing import InputKind
from openvima.policies.base import Policy
from openvima.policies.batch import Batch
from openvima.policies.build import config_to_dict
from openvima.policies.checkpoint import load_weights, write_checkpoint
from openvima.policies.naming import TOKENIZER_FOLDER, WEIGHTS_FILE
from openvima.policies.nn.layers import round_rows
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.processor import Processor
from openvima.policies.tensor_files import read_safetensors, write_safetensors
from openvima.policies.tokenizer import Vocabulary, WordTokenizer
from openvima.training.augmentation.demonstrations import add_false_positives, augment
from openvima.training.batches import Collate, Example
from openvima.training.config import AugmentationConfig
from openvima.user_code import call_function

LossAndMetrics = tuple[torch.Tensor, dict[str, torch.Tensor]]


class Learner(nn.Module):
    """Base class of trained modules; your own needs `collator`, `forward` and, for evaluation, `policy`.

    Attributes:
        input_kind: "objects" or "frames".
        score: Metric that selects the best checkpoint, from 0 to 1; larger is better.
    """

    input_kind: InputKind = "objects"
    score = "accuracy"

    def collator(self) -> Collate:
        """Return the function that makes a batch of demonstrations; it is pickled to loader workers.

        It is called with examples and one random generator for each, or None in validation. Draws of an
        example must come from its generator alone, so that they depend neither on the rest of the batch nor
        on the number of processes. A batch is a tensor, or has a method `to`.
        """
        raise NotImplementedError

    def forward(self, batch: Any) -> LossAndMetrics:
        """Return the loss and metrics by name, means over all steps of the batch."""
        raise NotImplementedError

    def policy(self) -> Policy:
        """Return the trained module as a policy, which `openvima evaluate --policy RUN` scores.

        It is called in evaluation mode, with the weights of a checkpoint.

        Raises:
            ConfigError: The class does not have this method of its own.
        """
        raise ConfigError(
            f"{type(self).__name__} has no method policy, which returns a policy with its weights; add one "
            "to evaluate the run."
        )

    def write(self, folder: Path) -> None:
        """Write a checkpoint."""
        # Copies, since a file holds no tensors that share memory, as tied weights do.
        weights = self.state_dict().items()
        tensors = {name: tensor.detach().to("cpu", copy=True).contiguous() for name, tensor in weights}
        write_safetensors(tensors, folder / WEIGHTS_FILE)

    def read(self, folder: Path) -> None:
        """Load the weights of a checkpoint.

        Raises:
            InputFileError: It is damaged or does not fit.
        """
        file = folder / WEIGHTS_FILE
        try:
            self.load_state_dict(read_safetensors(file))
        except RuntimeError as error:
            raise InputFileError(f"{file} does not fit: {error}") from None

    def description(self) -> dict[str, Any]:
        """Return the sizes of the network, for the run's `config.yaml`."""
        return {"learner": f"{type(self).__module__}:{type(self).__qualname__}"}


class PolicyLearner(Learner):
    """A policy of this package, trained by behaviour cloning.

    Args:
        network: The network; it is trained in place.
        processor: Its processor.
        augmentation: How demonstrations are augmented.
    """

    def __init__(
        self, network: PolicyNetwork, processor: Processor, augmentation: AugmentationConfig
    ) -> None:
        super().__init__()
        self.network = network
        self.processor = processor
        self.input_kind = processor.input_kind
        self.score = network.score
        self.features: torch.Tensor | None = None  # of all images, if their encoder is frozen
        self._augmentation = augmentation

    def collator(self) -> "PolicyCollate":
        """Return a `PolicyCollate`."""
        augmentation = self._augmentation
        return PolicyCollate(
            self.processor,
            augmentation.false_positive_prob,
            with_images=self.features is None,
            augmentation=augmentation,
        )

    def forward(self, batch: Batch) -> LossAndMetrics:
        """Return the loss of the action head, and its metrics."""
        network, features = self.network, self.features
        if (images := batch.images) is not None:
            if self.training:
                images = F.pad(images, (0, 0) * 3 + (0, round_rows(len(images)) - len(images)))
            features = network.encode_images(images)
        assert features is not None  # batches lack images only where there are features
        prompt = network.encode_prompt(batch.prompts, features)
        return network.loss(prompt, batch.history, features, batch.targets)

    def write(self, folder: Path) -> None:
        """Write a checkpoint that `load_policy` takes."""
        write_checkpoint(self.network, folder, self.processor.tokenizer)

    def read(self, folder: Path) -> None:
        """Load the weights of a checkpoint, which must have the same vocabulary."""
        tokenizer, file = self.processor.tokenizer, folder / WEIGHTS_FILE
        if isinstance(tokenizer, WordTokenizer):
            stored = Vocabulary.read(folder / TOKENIZER_FOLDER)
            if stored != tokenizer.vocabulary:
                raise InputFileError(
                    f"{folder} has another vocabulary, with {len(stored.words)} words instead of "
                    f"{len(tokenizer.vocabulary.words)}; train into another --out."
                )
        load_weights(self.network, read_safetensors(file), source=str(file))

    def description(self) -> dict[str, Any]:
        """Return all sizes of the network, and which vocabulary it has."""
        tokenizer, sizes = self.processor.tokenizer, config_to_dict(self.network.config)
        if not isinstance(tokenizer, WordTokenizer):
            return sizes
        words = tokenizer.vocabulary
        return {**sizes, "vocabulary": {"words": len(words.words), "digest": words.digest()}}


_UNCHANGED = AugmentationConfig()


@dataclass(frozen=True, slots=True)
class PolicyCollate:
    """Makes batches for a policy of this package.

    Args:
        processor: That of the network.
        false_positive_prob: Probability that a view of a step contains a false detection.
        with_images: Add the images in use to the batch, each once. Otherwise indices count through the
            images of all demonstrations.
        augmentation: How demonstrations are augmented, by default not at all; not in validation, unless all
            are inverse dynamics.
    """

    processor: Processor
    false_positive_prob: float
    _: KW_ONLY
    with_images: bool
    augmentation: AugmentationConfig = _UNCHANGED

    def __call__(
        self, examples: Sequence[Example], rngs: Sequence[np.random.Generator] | None = None
    ) -> Batch:
        """Make a batch; see `Learner.collator`."""
        added = [
            each for example in examples for each in (example.other, example.definer) if each is not None
        ]
        shown = [*examples, *added]
        first_images = None if self.with_images else [example.base for example in shown]
        numbered = number_images([example.episode for example in shown], first_images)
        others = iter(numbered[len(examples) :])
        episodes = [
            augment(
                episode,
                self.augmentation,
                rng,
                other=None if example.other is None else next(others),
                definer=None if example.definer is None else next(others),
                keeps_prompt=example.keeps_prompt,
            )
            for example, episode, rng in zip(examples, numbered, rngs or [None] * len(examples), strict=False)
        ]
        batch = self.processor.collate(episodes)
        if rngs is not None:
            batch = add_false_positives(
                batch, self.processor.layout, probability=self.false_positive_prob, rngs=rngs
            )
        return batch.with_images([episode.images for episode in numbered]) if self.with_images else batch


def make_learner(name: str) -> Learner:
    """Make a learner by the name of its function.

    Args:
        name: MODULE:FUNCTION or FILE.py:FUNCTION; the function takes no arguments and returns a `Learner`.

    Raises:
        ConfigError: There is no such function, it raises, or it returns something else.
    """
    learner = call_function(name, what="preset")
    if not isinstance(learner, Learner):
        raise ConfigError(f"{name} returned a {type(learner).__name__}; it must return a Learner.")
    return learner
