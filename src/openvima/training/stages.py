"""The two stages of a run: matching prompt and scene crops, then behaviour cloning."""

import math
import os
from collections.abc import Iterator, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import nn

from openvima.data.object_cache.cache import ObjectCache
from openvima.data.torch_dataset import BatchStream, batches_of
from openvima.errors import ConfigError
from openvima.policies.network import PolicyNetwork
from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.training.config import TrainingConfig
from openvima.training.learner import Learner, PolicyLearner
from openvima.training.occlusion import with_gaps
from openvima.training.parallel import Parallel
from openvima.training.pretrain import Pairs, matching_loss, pairs_again, scene_accuracy
from openvima.training.schedule import step_generator
from openvima.training.source import ExampleSource, Parts, by_length, order_of
from openvima.training.turning import joint_loss, mirrored, shifted, turn_accuracy

Metrics = dict[str, float]
CHUNK = 64  # demonstrations whose images are encoded together
MAX_FEATURES = 2_000_000  # images that are encoded once and kept, rather than in every step


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
    """Trains the crop encoder and the appearance embedding on rendered pairs; each process the same."""

    name = "1-matching"

    def __init__(self, model: PolicyNetwork, config: TrainingConfig, pairs: Pairs) -> None:
        self.learning_rate = config.pretraining_learning_rate
        assert isinstance(model.images, ObjectEncoder)  # the loop has seen to it
        self.encoder = model.images
        self.parameters = crop_parameters(model)
        held_out = pairs.scenes >= int(pairs.scenes.max()) * 0.95
        self._training = pairs.select(torch.nonzero(~held_out)[:, 0])
        self._validation = pairs.select(torch.nonzero(held_out)[:, 0])
        self._config = config

    def backward(self, step: int) -> Metrics:
        """Draw a batch of pairs and add its gradients."""
        config = self._config
        generator = step_generator(config.seed, self.name, step)
        batch = self._training.select(self._rows(generator).to(self._training.looks.device))
        if self.encoder.config.turn_bins:
            batch = mirrored(batch, generator)
        if config.pretraining_gaps:
            batch = with_gaps(batch, config.pretraining_gaps, generator)
        if config.pretraining_box_shift:
            batch = shifted(batch, config.pretraining_box_shift, generator)
        loss_of = matching_loss if batch.again is None else joint_loss
        loss, metrics = loss_of(self.encoder, batch, temperature=config.temperature, generator=generator)
        loss.backward()
        return {"loss": loss.item(), **{name: value.item() for name, value in metrics.items()}}

    def validate(self) -> Metrics:
        """Share of prompt images whose object is the most similar one in its scene.

        Where scenes are laid twice, the same share for objects laid again, and the share of right turns.
        """
        pairs = self._validation
        metrics = {"scene_accuracy": scene_accuracy(self.encoder, pairs)}
        if pairs.again:
            metrics["again_accuracy"] = scene_accuracy(self.encoder, pairs_again(pairs, pairs.again))
        if self.encoder.config.turn_bins:
            metrics["turn_accuracy"] = turn_accuracy(self.encoder, pairs)
        return metrics

    def _rows(self, generator: torch.Generator) -> torch.Tensor:
        """Draw a batch: of whole scenes if there are twins in them, to be told apart, else of any objects."""
        batch, scenes = self._config.pretraining_batch, self._training.scenes
        if not self._config.pretraining_twins:
            return torch.randperm(len(scenes), generator=generator)[:batch]
        rank = torch.rand(int(scenes.max()) + 1, generator=generator)
        return rank[scenes.cpu()].argsort(stable=True)[:batch]


class Cloning:
    """Behaviour cloning: the loss of a learner over whole demonstrations, read from the token cache.

    Args:
        learner: What is trained.
        module: What to call for its loss: the learner, perhaps wrapped for several processes.
        config: All settings.
        training: Demonstrations to learn from.
        validation: Demonstrations that choose the best checkpoint.
        parallel: The processes of the run.
        detected: Those to learn from, with the boxes of a detector, if they are to be mixed in.
    """

    name = "2-cloning"

    def __init__(
        self,
        learner: Learner,
        module: nn.Module,
        config: TrainingConfig,
        training: ExampleSource,
        validation: ExampleSource,
        parallel: Parallel,
        detected: ExampleSource | None = None,
    ) -> None:
        self.learning_rate = config.learning_rate
        self.parameters = [p for p in learner.parameters() if p.requires_grad]
        self._learner, self._module, self._config, self._parallel = learner, module, config, parallel
        self._training, self._validation, self._detected = training, validation, detected
        self._validated = module if parallel.is_sharded else learner
        self._order = order_of(
            training,
            batch=config.batch,
            seed=config.seed,
            bucket=config.bucket,
            rank=parallel.rank,
            num_ranks=parallel.num_ranks,
        )
        self._batches: Iterator[list[tuple[Any, int]]] = iter(())
        self._next_step = -1

    def backward(self, step: int) -> Metrics:
        """Take the step's demonstrations, in parts of like length, and add their gradients."""
        if step != self._next_step:
            self._batches = self._from(step)
        self._next_step = step + 1
        parts = next(self._batches)
        total = self._training.num_steps(self._order.rows_of_all(step))
        sums: Metrics = {}
        for number, (batch, num_steps) in enumerate(parts):
            # Processes average their gradients: each counts by its share of the steps of all.
            share = num_steps * self._parallel.num_ranks / total
            with self._parallel.shares(self._module, last=number == len(parts) - 1):
                loss, metrics = self._call(batch, self._module)
                (loss * share).backward()
            _add(sums, {"loss": loss, **metrics}, share)
        return sums

    @torch.no_grad()
    def validate(self) -> Metrics:
        """Loss and metrics on the held-out demonstrations; the learner names which accuracy is the score."""
        source, collate = self._validation, self._learner.collator()
        if not len(source):
            return {}
        total = source.num_steps(np.arange(len(source)))
        size = max(1, self._order.batch // self._parallel.num_ranks // self._config.accumulate)
        sums: Metrics = {}
        # Sorted by length, so that little is padded; processes take parts in turn.
        rows = np.lexsort(source.lengths.T[::-1])
        for number, start in enumerate(range(0, len(rows), size)):
            examples = [source[int(row)] for row in rows[start : start + size]]
            mine = number % self._parallel.num_ranks == self._parallel.rank
            if not (mine or self._parallel.is_sharded):  # a sharded network needs all processes at once
                continue
            for group in by_length(examples):
                loss, metrics = self._call(collate(group, None), self._validated)
                share = sum(e.episode.num_steps for e in group) / total
                _add(sums, {"loss": loss, **metrics}, share * mine * self._parallel.num_ranks)
        sums = self._parallel.mean(sums)
        score = sums[self._learner.score]
        return {**sums, "score": score, "score_error": math.sqrt(max(0.0, score * (1 - score)) / total)}

    def _from(self, step: int) -> Iterator[list[tuple[Any, int]]]:
        config = self._config
        ours = self._order.batch // self._parallel.num_ranks
        largest = -(-ours // config.accumulate)
        # Sharded weights are gathered at every pass, so all processes must make equally many.
        count = min(config.accumulate, ours) if self._parallel.is_sharded else None
        share = config.detected_share or 0.0
        strangers = self._training if config.stranger_share else None
        parts = Parts(
            self._learner.collator(),
            config.seed,
            largest,
            count,
            self._detected,
            share,
            strangers,
            config.stranger_share,
        )
        stream = BatchStream(self._training, self._order, first=step, transform=parts)
        return iter(batches_of(stream, num_workers=min(config.loader_workers, _num_processors())))

    def _call(
        self, batch: Any, module: nn.Module
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:  # Any: a learner's own
        device = self._parallel.device
        kind = torch.bfloat16 if self._config.precision == "bfloat16" else None
        with torch.autocast(device.type, kind, enabled=kind is not None):
            loss, metrics = module(batch if device.type == "cpu" else batch.to(device))
        if self._learner.score not in metrics:  # said at the first step, not at the first checkpoint
            raise ConfigError(
                f"the learner's score is {self._learner.score!r}, but its forward returns "
                f"{', '.join(sorted(metrics)) or 'no metrics'}; name one of them as its score."
            )
        return loss, metrics


def keeps_crops(network: PolicyNetwork, config: TrainingConfig) -> bool:
    """Whether the crop encoder stays as it is: it has matched looks, here or where the weights come from."""
    images = network.images
    matches = isinstance(images, ObjectEncoder) and images.config.appearance_width > 0
    return matches and bool(config.pretraining_steps or config.init) and not config.tune_crops


def has_turns(network: PolicyNetwork) -> bool:
    """Whether a network compares how objects lie in two images."""
    return isinstance(network.images, ObjectEncoder) and network.images.config.turn_bins > 0


def freeze_crops(learner: PolicyLearner, caches: Sequence[ObjectCache]) -> None:
    """Leave the crop encoder as it is; where there are not too many images, encode each once and for all.

    Args:
        learner: Whose encoder.
        caches: All that is learnt from; their images are numbered one cache after the other.
    """
    for parameter in crop_parameters(learner.network):
        parameter.requires_grad_(False)
    count = sum(int(cache.image_counts().sum()) for cache in caches)
    if count > MAX_FEATURES:
        return
    device = next(learner.parameters()).device
    height, width = learner.reader.image_size
    parts = [np.zeros((1, 3, height, width), np.uint8)]  # number 0 is black
    features = []
    with torch.no_grad():
        for cache in caches:
            for start in range(0, len(cache), CHUNK):
                parts += [episode.images for episode in cache[start : start + CHUNK]]
                images = torch.from_numpy(np.concatenate(parts)).to(device)
                features.append(learner.network.encode_images(images))
                parts = []
    learner.features = torch.cat(features)


def crop_parameters(model: PolicyNetwork) -> list[torch.nn.Parameter]:
    """What the first stage trains, and cloning leaves alone."""
    images = model.images
    if not isinstance(images, ObjectEncoder):
        return list(images.frame_encoder.parameters())
    appearance = list(images.appearance.parameters()) if images.config.appearance_width else []
    turns = list(images.turns.parameters()) if images.config.turn_bins else []
    return [*images.crop_encoder.parameters(), *appearance, *turns]


def _num_processors() -> int:
    """How many this process may use; more readers than these would be in each other's way."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _add(sums: Metrics, values: dict[str, torch.Tensor], share: float) -> None:
    for name, value in values.items():
        sums[name] = sums.get(name, 0.0) + value.item() * share
