"""Contrastive pretraining as a stage of training."""

import torch

from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.training.augmentation.occlusion import with_gaps
from openvima.training.config import PretrainingConfig
from openvima.training.loop import Metrics
from openvima.training.pretrain import Pairs, matching_loss, pairs_again, scene_accuracy
from openvima.training.schedule import step_generator
from openvima.training.turning import joint_loss, mirrored, shifted, turn_accuracy

_VALIDATION_SCENES = 0.05  # the last ones
_PURPOSE = "1-matching"  # hashed into the seed of every batch; another word would change all runs


class ContrastivePretraining:
    """Trains the crop encoder, appearance embedding and relative rotation on rendered pairs.

    Every process does the same.

    Args:
        network: Its object encoder is trained.
        config: Settings of the stage.
        seed: Of the run.
        pairs: Objects in prompt images and scenes, on the device of the network.
    """

    name = "1-pretraining"

    def __init__(self, network: PolicyNetwork, config: PretrainingConfig, seed: int, pairs: Pairs) -> None:
        assert network.object_encoder is not None  # `resolved` has checked it
        self.learning_rate = config.learning_rate
        self.encoder = network.object_encoder
        self.parameters = crop_parameters(network)
        held_out = pairs.scenes >= int(pairs.scenes.max()) * (1 - _VALIDATION_SCENES)
        self._training = pairs.select(torch.nonzero(~held_out)[:, 0])
        self._validation = pairs.select(torch.nonzero(held_out)[:, 0])
        self._config, self._seed = config, seed

    def backward(self, step: int) -> Metrics:
        """Draw a batch of pairs and add its gradients."""
        config = self._config
        generator = step_generator(self._seed, _PURPOSE, step)
        batch = self._training.select(self._rows(generator).to(self._training.looks.device))
        if self.encoder.config.rotation_bins:
            batch = mirrored(batch, generator)
        if config.occlusion_prob:
            batch = with_gaps(batch, config.occlusion_prob, generator)
        if config.box_jitter_px:
            batch = shifted(batch, config.box_jitter_px, generator)
        loss_of = matching_loss if batch.again is None else joint_loss
        loss, metrics = loss_of(self.encoder, batch, temperature=config.temperature, generator=generator)
        loss.backward()
        return {"loss": loss.item(), **{name: value.item() for name, value in metrics.items()}}

    def validate(self) -> Metrics:
        """Return the accuracy of retrieving objects of held-out scenes, and of their rotations.

        Objects are retrieved among those of their scene: by prompt image, and by the second view if scenes
        have one.
        """
        pairs = self._validation
        metrics = {"retrieval_accuracy": scene_accuracy(self.encoder, pairs)}
        if pairs.again:
            metrics["second_view_accuracy"] = scene_accuracy(self.encoder, pairs_again(pairs, pairs.again))
        if self.encoder.config.rotation_bins:
            metrics["rotation_accuracy"] = turn_accuracy(self.encoder, pairs)
        return metrics

    def _rows(self, generator: torch.Generator) -> torch.Tensor:
        """Draw a batch: of whole scenes if they contain hard negatives, else of any objects."""
        batch_size, scenes = self._config.batch_size, self._training.scenes
        if not self._config.hard_negative_prob:
            return torch.randperm(len(scenes), generator=generator)[:batch_size]
        rank = torch.rand(int(scenes.max()) + 1, generator=generator)
        return rank[scenes.cpu()].argsort(stable=True)[:batch_size]


def compares_rotations(network: PolicyNetwork) -> bool:
    """Whether a network estimates the relative rotation of objects in two images."""
    encoder = network.object_encoder
    return encoder is not None and encoder.config.rotation_bins > 0


def crop_parameters(network: PolicyNetwork) -> list[torch.nn.Parameter]:
    """Return what pretraining trains, and behaviour cloning keeps frozen."""
    encoder = network.object_encoder
    if encoder is None:
        return list(network.get_submodule("frame_encoder").parameters())
    appearance = list(encoder.appearance.parameters()) if encoder.config.appearance_width else []
    rotation = list(encoder.rotation.parameters()) if encoder.config.rotation_bins else []
    return [*encoder.crop_encoder.parameters(), *appearance, *rotation]
