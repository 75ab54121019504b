"""Contrastive pretraining as a stage of training."""

from collections.abc import Callable

import numpy as np
import torch

from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.pointer.model import Pointer
from openvima.policies.pointer.words import Attributes
from openvima.training.augmentation.box_jitter import with_box_jitter
from openvima.training.augmentation.horizontal_flip import with_horizontal_flips
from openvima.training.augmentation.occlusion import with_occlusion
from openvima.training.config import PretrainingConfig
from openvima.training.loop import Metrics
from openvima.training.parallel import Parallel
from openvima.training.pretraining.attribute_loss import attribute_accuracy, caption_loss
from openvima.training.pretraining.captions import sample_captions
from openvima.training.pretraining.contrastive import contrastive_loss, retrieval_accuracy
from openvima.training.pretraining.pairs import Pairs
from openvima.training.pretraining.rotation import rotation_accuracy
from openvima.training.schedule import step_generator, step_seed

_NUM_CAPTIONS, _CAPTION_BATCH = 4096, 64
_VALIDATION_SCENES = 0.05  # the last ones
_PURPOSE = "1-matching"  # hashed into the seed of every batch; changing it would change all runs


class ContrastivePretraining:
    """Trains the crop encoder, appearance embedding and relative rotation on rendered pairs.

    Processes share the encoding of crops, and do the rest alike.

    Args:
        network: Its object encoder is trained.
        config: Settings of the stage.
        seed: Of the run.
        pairs: Objects in prompt images and scenes, on the device of the network.
        parallel: The processes of the run.
        encode: Encodes the captions of attributes, if they are trained.
    """

    name = "1-pretraining"

    def __init__(
        self,
        network: PolicyNetwork,
        config: PretrainingConfig,
        seed: int,
        pairs: Pairs,
        parallel: Parallel,
        encode: Callable[[str], list[int]] | None = None,
    ) -> None:
        assert network.object_encoder is not None  # `resolved` has checked it
        self.learning_rate = config.learning_rate
        self.encoder = network.object_encoder
        self.parameters = crop_parameters(network)
        held_out = pairs.scenes >= int(pairs.scenes.max()) * (1 - _VALIDATION_SCENES)
        self._training = pairs.select(torch.nonzero(~held_out)[:, 0])
        self._validation = pairs.select(torch.nonzero(held_out)[:, 0])
        self._config, self._seed, self._parallel = config, seed, parallel
        self._attributes = attributes_of(network) if config.attribute_loss_weight else None
        if self._attributes:
            assert encode is not None
            rng = np.random.default_rng(step_seed(seed, "captions", 0))
            self._captions = sample_captions(_NUM_CAPTIONS, encode, rng).to(pairs.scenes.device)

    def backward(self, step: int) -> Metrics:
        """Draw a batch of pairs and add its gradients."""
        config = self._config
        generator = step_generator(self._seed, _PURPOSE, step)
        batch = self._training.select(self._rows(generator).to(self._training.scenes.device))
        if self.encoder.config.rotation_bins:
            batch = with_horizontal_flips(batch, generator)
        if config.occlusion_prob:
            batch = with_occlusion(batch, config.occlusion_prob, generator)
        if config.box_jitter_px:
            batch = with_box_jitter(batch, config.box_jitter_px, generator)
        loss, metrics = contrastive_loss(
            self.encoder,
            batch,
            temperature=config.temperature,
            generator=generator,
            attributes=self._attributes,
            attribute_weight=config.attribute_loss_weight,
            parallel=self._parallel,
        )
        if self._attributes:
            rows = torch.randint(len(self._captions.targets), (_CAPTION_BATCH,), generator=generator)
            metrics["loss/captions"] = caption_loss(self._attributes, self._captions.select(rows))
            loss = loss + metrics["loss/captions"]
        loss.backward()
        self._parallel.average_gradients(self.parameters)
        return {"loss": loss.item(), **{name: value.item() for name, value in metrics.items()}}

    def validate(self) -> Metrics:
        """Return the accuracy of retrieving objects of held-out scenes, and of their rotations.

        Objects are retrieved among those of their scene: by prompt image, and by the second view if scenes
        have one.
        """
        pairs = self._validation
        metrics = {"retrieval_accuracy": retrieval_accuracy(self.encoder, pairs)}
        if pairs.second_view:
            metrics["second_view_accuracy"] = retrieval_accuracy(self.encoder, pairs.second_view_pairs())
        if self.encoder.config.rotation_bins:
            metrics["rotation_accuracy"] = rotation_accuracy(self.encoder, pairs)
        if self._attributes:
            of_attributes = attribute_accuracy(self.encoder, self._attributes, pairs)
            metrics |= {f"{name}_accuracy": value for name, value in of_attributes.items()}
        return metrics

    def _rows(self, generator: torch.Generator) -> torch.Tensor:
        """Draw a batch: of whole scenes if they contain hard negatives, else of any objects."""
        batch_size, scenes = self._config.batch_size, self._training.scenes
        if not self._config.hard_negative_prob:
            return torch.randperm(len(scenes), generator=generator)[:batch_size]
        rank = torch.rand(int(scenes.max()) + 1, generator=generator)
        return rank[scenes.cpu()].argsort(stable=True)[:batch_size]


def attributes_of(network: PolicyNetwork) -> Attributes | None:
    """Return the attributes in which a network compares objects, if it does."""
    return network.attributes if isinstance(network, Pointer) else None


def compares_rotations(network: PolicyNetwork) -> bool:
    """Whether a network estimates the relative rotation of objects in two images."""
    encoder = network.object_encoder
    return encoder is not None and encoder.config.rotation_bins > 0


def crop_parameters(network: PolicyNetwork) -> list[torch.nn.Parameter]:
    """Return what pretraining trains, and behaviour cloning keeps frozen."""
    encoder = network.object_encoder
    assert encoder is not None  # only networks with an appearance embedding are pretrained or frozen
    appearance = list(encoder.appearance.parameters()) if encoder.config.appearance_width else []
    rotation = list(encoder.rotation.parameters()) if encoder.config.rotation_bins else []
    of_attributes = list(attributes.parameters()) if (attributes := attributes_of(network)) else []
    return [*encoder.crop_encoder.parameters(), *appearance, *rotation, *of_attributes]
