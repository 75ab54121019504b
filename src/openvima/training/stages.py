"""The two stages of a run: matching prompt and scene crops, then behaviour cloning."""

import math
from dataclasses import replace
from typing import Protocol

import torch

from openvima.policies.heads.base import HeadInputs
from openvima.policies.inputs import Reader
from openvima.policies.layers.object_encoder import ObjectEncoder
from openvima.policies.network import PolicyNetwork
from openvima.training.augment import augmented
from openvima.training.collate import Collator
from openvima.training.config import TrainingConfig
from openvima.training.dataset import (
    Batch,
    Examples,
    groups_of_equal_length,
    rows_of_step,
)
from openvima.training.pretrain import Pairs, matching_loss, scene_accuracy
from openvima.training.schedule import step_generator

Metrics = dict[str, float]


class Stage(Protocol):
    """One loss to be minimised for a number of steps.

    Attributes:
        name: In file names and metrics.
        learning_rate: Highest learning rate.
        parameters: What is trained.
    """

    name: str
    learning_rate: float
    parameters: list[torch.nn.Parameter]

    def backward(self, step: int) -> Metrics:
        """Add the gradients of one step's loss, and return its metrics."""
        ...

    def validate(self) -> Metrics:
        """Return metrics on held-out data: "score", the larger the better, and its standard error."""
        ...


class Matching:
    """Trains the crop encoder and the appearance embedding on rendered pairs."""

    name = "1-matching"

    def __init__(self, model: PolicyNetwork, config: TrainingConfig, pairs: Pairs) -> None:
        self.learning_rate = config.pretraining_learning_rate
        assert isinstance(model.images, ObjectEncoder)  # the loop has seen to it
        self.encoder = model.images
        self.parameters = _crop_parameters(model)
        held_out = pairs.scenes >= int(pairs.scenes.max()) * 0.95
        self._training = pairs.select(torch.nonzero(~held_out)[:, 0])
        self._validation = pairs.select(torch.nonzero(held_out)[:, 0])
        self._config = config

    def backward(self, step: int) -> Metrics:
        """Draw a batch of pairs and add its gradients."""
        config = self._config
        generator = step_generator(config.seed, self.name, step)
        count = len(self._training.looks)
        rows = torch.randperm(count, generator=generator)[: config.pretraining_batch]
        loss, metrics = matching_loss(
            self.encoder, self._training.select(rows), temperature=config.temperature, generator=generator
        )
        loss.backward()
        return {"loss": loss.item(), **{name: value.item() for name, value in metrics.items()}}

    def validate(self) -> Metrics:
        """Share of prompt images whose object is the most similar one in its scene."""
        accuracy = scene_accuracy(self.encoder, self._validation)
        return {"scene_accuracy": accuracy}


class Cloning:
    """Behaviour cloning: the loss of the action head over whole demonstrations.

    After a matching stage the crop encoder stays as it is and each crop is encoded once, unless crops are to
    be tuned. Without such a stage the image encoder is trained here; each step encodes its images, each once.
    """

    name = "2-cloning"

    def __init__(
        self, model: PolicyNetwork, config: TrainingConfig, examples: Examples, reader: Reader
    ) -> None:
        self.learning_rate = config.learning_rate
        self.model = model
        self._collate = Collator(reader)
        self._config = config
        self._examples = examples
        self._features: torch.Tensor | None = None
        tunes = config.tune_crops or not config.pretraining_steps  # a fresh encoder must be trained here
        frozen = set() if tunes else set(_crop_parameters(model))
        self.parameters = [p for p in model.parameters() if p.requires_grad and p not in frozen]
        if not tunes:
            self._features = encode_in_chunks(model, examples.images)

    def backward(self, step: int) -> Metrics:
        """Take the step's demonstrations, in groups of like length, and add their gradients."""
        config = self._config
        training = self._examples.training
        rows = rows_of_step(len(training), batch=config.batch, step=step, seed=config.seed)
        generator = step_generator(config.seed, "augmentation", step)
        chosen = [training[row] for row in rows]
        total = sum(example.tokens.num_steps for example in chosen)
        sums: Metrics = {}
        for group in groups_of_equal_length(chosen):
            batch = augmented(
                self._collate(group),
                self._collate.reader.layout,
                probability=config.spurious_probability,
                generator=generator,
            )
            share = sum(example.tokens.num_steps for example in group) / total
            loss, metrics = self._loss(batch)
            (loss * share).backward()
            for name, value in {"loss": loss, **metrics}.items():
                sums[name] = sums.get(name, 0.0) + value.item() * share
        return sums

    @torch.no_grad()
    def validate(self) -> Metrics:
        """Loss and metrics on the held-out demonstrations; the score is the accuracy that the head names."""
        examples = self._examples.validation
        if not examples:
            return {}
        total = sum(example.tokens.num_steps for example in examples)
        sums: Metrics = {}
        for group in groups_of_equal_length(examples):
            for start in range(0, len(group), self._config.batch):
                part = group[start : start + self._config.batch]
                share = sum(example.tokens.num_steps for example in part) / total
                loss, metrics = self._loss(self._collate(part))
                for name, value in {"loss": loss, **metrics}.items():
                    sums[name] = sums.get(name, 0.0) + value.item() * share
        score = sums[self.model.head.score]
        return {**sums, "score": score, "score_error": math.sqrt(score * (1 - score) / total)}

    def _loss(self, batch: Batch) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        features, batch = (self._features, batch) if self._features is not None else self._encoded(batch)
        return self.model.head.loss(self._inputs(batch, features), batch.targets)

    def _inputs(self, batch: Batch, features: torch.Tensor) -> HeadInputs:
        memory = self.model.encode_prompts(batch.prompts, features)
        return self.model(memory, batch.history, features, batch.targets.actions_BTC)

    def _encoded(self, batch: Batch) -> tuple[torch.Tensor, Batch]:
        """Encode the crops of a batch, each once, and number them anew."""
        prompts, history = batch.prompts, batch.history
        numbers = torch.cat([prompts.crops_VS.flatten(), history.crops_BTVN.flatten()])
        used, places = numbers.unique(return_inverse=True)
        prompt_places, history_places = places.split([prompts.crops_VS.numel(), history.crops_BTVN.numel()])
        prompts = replace(prompts, crops_VS=prompt_places.view_as(prompts.crops_VS))
        history = replace(history, crops_BTVN=history_places.view_as(history.crops_BTVN))
        features = self.model.encode_images(self._examples.images[used])
        return features, replace(batch, prompts=prompts, history=history)


@torch.no_grad()
def encode_in_chunks(model: PolicyNetwork, images: torch.Tensor, *, chunk: int = 1024) -> torch.Tensor:
    """Encode many images without gradients, shape (K, F)."""
    return torch.cat([model.encode_images(part) for part in images.split(chunk)])


def _crop_parameters(model: PolicyNetwork) -> list[torch.nn.Parameter]:
    """What the first stage trains, and cloning leaves alone."""
    images = model.images
    if not isinstance(images, ObjectEncoder):
        return list(images.frame_encoder.parameters())
    appearance = list(images.appearance.parameters()) if images.config.appearance_width else []
    return [*images.crop_encoder.parameters(), *appearance]
