"""Behaviour cloning as a stage of training."""

import math
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np
import torch
from torch import nn

from openvima.data.object_cache import ObjectCache
from openvima.errors import ConfigError
from openvima.multiprocess import num_cpus
from openvima.perception.preprocessing import IMAGE_SIZES
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.training.batches import BatchMaker, ExampleSource, read_batches
from openvima.training.config import TrainingConfig
from openvima.training.learner import Learner, LossAndMetrics, PolicyLearner
from openvima.training.loop import Metrics
from openvima.training.parallel import Parallel
from openvima.training.pretraining.stage import crop_parameters
from openvima.training.source import find_definers, make_order

CHUNK = 64  # demonstrations per batch of precomputed features
MAX_FEATURES = 4_000_000  # images, about 1 kB each; above, features are computed in every step


class BehaviourCloning:
    """Minimises the loss of a learner on whole demonstrations from the object cache.

    Args:
        learner: The trained module.
        config: All settings.
        training: Demonstrations to train on.
        validation: Held-out demonstrations.
        parallel: The processes of the run.
        alternatives: Other caches of the training demonstrations, each with the probability of using it.
    """

    name = "2-cloning"

    def __init__(
        self,
        learner: Learner,
        config: TrainingConfig,
        training: ExampleSource,
        validation: ExampleSource,
        parallel: Parallel,
        alternatives: tuple[tuple[ExampleSource, float], ...] = (),
    ) -> None:
        self.learning_rate = config.optimizer.learning_rate
        self.parameters = [p for p in learner.parameters() if p.requires_grad]
        self._learner, self._module = learner, parallel.wrap(learner)
        self._config, self._parallel = config, parallel
        self._training, self._validation, self._alternatives = training, validation, alternatives
        self._order = make_order(training, config.loader, config.seed, parallel)
        self._batches: Iterator[list[tuple[Any, int]]] = iter(())
        self._next_step = -1

    def backward(self, step: int) -> Metrics:
        """Add the gradients of one batch, in parts of similar length."""
        if step != self._next_step:
            self._batches = self._from(step)
        self._next_step = step + 1
        parts = next(self._batches)
        total = self._training.num_steps(self._order.rows_of_all(step))
        sums: Metrics = {}
        for number, (batch, num_steps) in enumerate(parts):
            # Gradients are averaged over processes: each counts by its fraction of all steps.
            weight = num_steps * self._parallel.num_ranks / total
            is_alone, is_last = self._parallel.num_ranks == 1, number == len(parts) - 1
            # Gradients are synchronized in the last backward pass of a step only.
            with nullcontext() if is_alone or is_last else self._module.no_sync():  # type: ignore[operator]
                loss, metrics = self._call(batch, self._module)
                weighted = loss * weight
                # DDP waits for a gradient of every parameter; prompts without images leave some out.
                if not is_alone:
                    weighted = weighted + 0.0 * torch.stack([each.sum() for each in self.parameters]).sum()
                weighted.backward()
            _add(sums, {"loss": loss, **metrics}, weight)
        return sums

    @torch.no_grad()
    def validate(self) -> Metrics:
        """Return loss and metrics on held-out demonstrations; `Learner.score` names the score.

        There are none as long as some tasks are shown alone: scores of others mean nothing, and scores of
        these alone cannot be compared with later ones.
        """
        source, collate = self._validation, self._learner.collator()
        if not len(source) or 0 < self._order.first_batches >= self._next_step:
            return {}
        total = source.num_steps(np.arange(len(source)))
        ranks, parts = self._parallel.num_ranks, self._config.optimizer.grad_accum_steps
        size = max(1, self._order.batch_size // ranks // parts)
        sums: Metrics = {}
        # Sorted by length, to reduce padding; processes take parts in turn.
        rows = np.lexsort(source.lengths.T[::-1])
        for start in range(self._parallel.rank * size, len(rows), ranks * size):
            for group in source.by_length(rows[start : start + size]):
                batch = collate([source[index] for index in group.tolist()], None)
                loss, metrics = self._call(batch, self._learner)
                weight = source.num_steps(group) / total
                _add(sums, {"loss": loss, **metrics}, weight * ranks)
        sums = self._parallel.mean(sums)
        score = sums[self._learner.score]
        return {**sums, "score": score, "score_error": math.sqrt(max(0.0, score * (1 - score)) / total)}

    def _from(self, step: int) -> Iterator[list[tuple[Any, int]]]:
        config, parts = self._config, self._config.optimizer.grad_accum_steps
        unused_definitions_prob = config.augmentation.unused_definitions_prob
        ours = self._order.batch_size // self._parallel.num_ranks
        make = BatchMaker(
            self._training,
            self._learner.collator(),
            config.seed,
            largest=-(-ours // parts),
            alternatives=self._alternatives,
            distractor_prob=config.augmentation.distractor_prob,
            definers=find_definers(self._training) if unused_definitions_prob else (),
            unused_definitions_prob=unused_definitions_prob,
            first_batches=self._order.first_batches,
        )
        workers = min(config.loader.num_workers, num_cpus())
        return iter(read_batches(self._order, make, first=step, num_workers=workers))

    def _call(self, batch: Any, module: nn.Module) -> LossAndMetrics:
        device = self._parallel.device
        with self._parallel.autocast(self._config.runtime.precision):
            loss, metrics = module(batch if device.type == "cpu" else batch.to(device))
        if self._learner.score not in metrics:  # at the first step, not at the first checkpoint
            raise ConfigError(
                f"the learner's score is {self._learner.score!r}, but its forward returns "
                f"{', '.join(sorted(metrics)) or 'no metrics'}; name one of them as its score."
            )
        return loss, metrics


def freezes_crops(network: PolicyNetwork, config: TrainingConfig) -> bool:
    """Whether the crop encoder is frozen, since this run or that of the initial weights pretrained it.

    Initial weights tell of it by their appearance embedding, which nothing else trains.
    """
    encoder, pretraining = network.object_encoder, config.pretraining
    if encoder is None:
        return False
    if pretraining.finetune_crop_encoder is not None:
        return not pretraining.finetune_crop_encoder
    pretrained = pretraining.steps or config.crops_from
    return bool(pretrained or (config.init_from and encoder.config.appearance_width))


def freeze_crops(learner: PolicyLearner, caches: Sequence[ObjectCache], parallel: Parallel) -> None:
    """Freeze the crop encoder, and precompute the features of all images unless there are too many.

    Args:
        learner: Its crop encoder is frozen.
        caches: All training data; image indices count through all of them.
        parallel: Processes that share the work.
    """
    for parameter in crop_parameters(learner.network):
        parameter.requires_grad_(False)
    count = sum(int(cache.image_counts().sum()) for cache in caches)
    if count > MAX_FEATURES:
        return
    device = next(learner.parameters()).device
    height, width = IMAGE_SIZES[learner.input_kind]
    chunks = [(cache, start) for cache in caches for start in range(0, len(cache), CHUNK)]
    with torch.no_grad():
        black = learner.network.encode_images(
            torch.zeros(1, 3, height, width, dtype=torch.uint8, device=device)
        )
        features = [black[: parallel.is_first]]  # it has index 0
        for number in parallel.part_of(len(chunks)):
            cache, start = chunks[number]
            rows = range(start, min(start + CHUNK, len(cache)))
            images = np.concatenate([cache[row].images for row in rows])
            features.append(learner.network.encode_images(torch.from_numpy(images).to(device)))
    learner.features = parallel.rows_of_all(torch.cat(features))


def _add(sums: Metrics, values: dict[str, torch.Tensor], weight: float) -> None:
    for name, value in values.items():
        sums[name] = sums.get(name, 0.0) + value.item() * weight
