"""Training a policy: contrastive pretraining, then behaviour cloning."""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from openvima.catalog.packs import load_assets
from openvima.data.object_cache import (
    Boxes,
    ObjectCache,
    Variant,
    check_object_cache,
    open_object_cache,
)
from openvima.data.reader import Dataset
from openvima.detector.plugins import detected_object_cache, plugged_boxes
from openvima.errors import ConfigError
from openvima.multiprocess import Report
from openvima.policies.loading import held_out_data
from openvima.tasks.registry import held_out_tasks, list_tasks
from openvima.training.batches import ExampleSource
from openvima.training.behaviour_cloning import BehaviourCloning, freeze_crops, freezes_crops
from openvima.training.building import build_learner, resolve, training_texts
from openvima.training.config import TrainingConfig
from openvima.training.learner import Learner, PolicyLearner
from openvima.training.loop import (
    Animate,
    PlannedStage,
    Rollout,
    Stage,
    Trainer,
    num_steps,
    open_run,
)
from openvima.training.parallel import Parallel
from openvima.training.pretraining.pairs import render_pairs
from openvima.training.pretraining.stage import ContrastivePretraining
from openvima.training.run_folder import held_out_demonstrations
from openvima.training.source import (
    alternative_source,
    check_scenes,
    open_demonstrations,
    read_actions,
    repeat_tasks,
    split_examples,
)

# Their start takes as long as a worker needs for so many.
_SCENES_PER_WORKER, _DEMONSTRATIONS_PER_WORKER = 200, 500


def train(
    config: TrainingConfig,
    report: Report | None = None,
    rollout: Rollout | None = None,
    animate: Animate | None = None,
) -> Path:
    """Train a policy on demonstrations, or resume an interrupted run.

    With the same settings and number of threads an interrupted run on a CPU ends with the very weights of an
    uninterrupted one. Started by `torchrun`, all its processes train together.

    Args:
        config: All settings.
        report: Called with steps done, steps in all, and a note.
        rollout: Called with a checkpoint every `config.rollout.every` steps; returns what to log.
        animate: Called with the same checkpoints; returns animations for TensorBoard and Weights & Biases.

    Returns:
        The run folder; `load_policy` takes it.

    Raises:
        ConfigError: The folder holds a run with other settings, preset and settings contradict each other,
            there is no such detector or excluded task, or the loss diverged.
        DatasetError: There are no demonstrations, some are held out for evaluation, or one is too long for
            the network.
        InputFileError: The last checkpoint or the detector is damaged, or T5 is not where the settings say,
            or of other sizes.
        PromptError: A prompt has a word that T5 lacks, or the prompts have too many different words.
        FolderLockedError: Another run writes to the folder.
        MissingExtraError: The preset encodes prompts with T5, or `runtime.wandb` names a project, and a
            package for that is not installed.
    """
    config = resolve(config)
    load_assets(config.assets)  # fails before there is a run folder
    dataset = open_demonstrations(config.data, config.loader, allow_heldout=config.allow_heldout)
    if config.loader.rerendered_prob:
        check_scenes(dataset)
    boxes = None
    if config.loader.boxes is not None:
        boxes = plugged_boxes(config.loader.boxes, fraction=config.loader.detected_fraction)
    weights = filter(None, (config.init_from, config.crops_from))
    held_out = set(held_out_demonstrations(dataset)).union(*map(held_out_data, weights))
    # What identifies the demonstrations besides their index.
    origin = {"boxes": boxes and boxes.name, "held_out": sorted(held_out)}
    with open_run(config) as parallel:
        with_captions = config.pretraining.attribute_loss_weight > 0
        texts = training_texts(dataset, config.augmentation, with_captions=with_captions)
        learner = build_learner(config, texts)
        if boxes and learner.input_kind == "frames":
            raise ConfigError(
                f"loader.boxes is {config.loader.boxes!r}, but preset {config.preset!r} takes whole frames; "
                "leave it out, or take a preset that takes objects."
            )
        if parallel.is_first:  # before pretraining, which comes first and may take hours
            for variant, _ in _variants(config, boxes):
                check_object_cache(dataset, learner.input_kind, variant, folder=config.object_cache)
        trainer = Trainer(
            config,
            dataset,
            learner,
            parallel,
            report=report,
            rollout=rollout,
            rollout_every=config.rollout.every,
            animate=animate,
            demonstrations={name: what for name, what in origin.items() if what},
        )
        return trainer.train(_Stages(config, dataset, boxes, learner, parallel, trainer).planned())


def _variants(config: TrainingConfig, boxes: Boxes | None) -> list[tuple[Variant, float]]:
    """Return which object caches a run reads, each with the probability of using it.

    The first is that of validation: true boxes, if any are used. Those of detected boxes and of random
    appearance follow.
    """
    loader, detected_prob = config.loader, config.loader.detected_prob or 0.0
    stored = [(Variant(), 1 - detected_prob - loader.rerendered_prob)] if detected_prob < 1 else []
    detected = [(Variant(boxes), detected_prob)] if detected_prob > 0 else []
    rerendered = [(Variant(appearance=0), loader.rerendered_prob)] if loader.rerendered_prob else []
    return [*stored, *detected, *rerendered]


@dataclass(eq=False)
class _Stages:
    """Builds the stages of a run."""

    config: TrainingConfig
    dataset: Dataset
    boxes: Boxes | None
    learner: Learner
    parallel: Parallel
    trainer: Trainer

    def planned(self) -> list[PlannedStage]:
        """Return the stages in order."""
        config = self.config
        steps = num_steps(config.schedule, lambda: len(self._examples[0]), config.loader.batch_size)
        stages: list[PlannedStage] = [(steps, self._behaviour_cloning)]
        if config.pretraining.steps:
            stages.insert(0, (config.pretraining.steps, self._pretraining))
        return stages

    def _pretraining(self) -> Stage:
        assert isinstance(self.learner, PolicyLearner)  # `resolve` has checked it
        network, config = self.learner.network, self.config.pretraining
        rotation_bins = network.object_encoder.config.rotation_bins if network.object_encoder else 0
        pairs = render_pairs(
            scene_tasks(self.dataset),
            config,
            seed=self.config.seed,
            assets=self.config.assets,
            second_view=max(rotation_bins, config.hard_negative_prob, config.attribute_loss_weight) > 0,
            report=self._say,
            parallel=self.parallel,
            workers=self._workers(config.num_scenes // _SCENES_PER_WORKER),
        )
        encode = self.learner.processor.tokenizer.encode
        return ContrastivePretraining(network, config, self.config.seed, pairs, self.parallel, encode)

    def _behaviour_cloning(self) -> Stage:
        self.trainer.report(f"reading {len(self.dataset)} demonstrations")
        caches, config, learner = [cache for cache, _ in self._caches], self.config, self.learner
        if isinstance(learner, PolicyLearner):
            if not (config.init_from or self.trainer.progress.step):
                learner.network.fit_prior(read_actions(self._examples[0]))
            if freezes_crops(learner.network, config):
                self.trainer.report("encoding the images of all demonstrations")
                freeze_crops(learner, caches, self.parallel)
        training, validation = self._examples
        num_images = np.cumsum([cache.image_counts().sum() for cache in caches])
        alternatives = tuple(  # the training demonstrations as the other caches have them
            (alternative_source(cache, training, first), prob)
            for (cache, prob), first in zip(self._caches[1:], num_images.tolist(), strict=False)
        )
        return BehaviourCloning(learner, config, training, validation, self.parallel, alternatives)

    @cached_property
    def _examples(self) -> tuple[ExampleSource, ExampleSource]:
        """Demonstrations to train on, and held-out ones."""
        loader = self.config.loader
        training, validation = split_examples(self._caches[0][0], loader)
        return repeat_tasks(training, loader.repeats), validation

    @cached_property
    def _caches(self) -> list[tuple[ObjectCache, float]]:
        """Object caches of `_variants`, with their probabilities; the first process builds missing ones."""
        # Another training may write the cache now.
        options = {"folder": self.config.object_cache, "report": self._say, "timeout_s": math.inf}
        workers = self._workers(len(self.dataset) // _DEMONSTRATIONS_PER_WORKER)
        caches = []
        if not self.parallel.is_first:
            self.parallel.wait()
        for variant, prob in _variants(self.config, self.boxes):
            if variant.boxes is not None:
                cache = detected_object_cache(self.dataset, variant.boxes, **options)
            else:
                kind, appearance = self.learner.input_kind, variant.appearance
                cache = open_object_cache(
                    self.dataset, kind, appearance=appearance, workers=workers, **options
                )
            caches.append((cache, prob))
        if self.parallel.is_first:
            self.parallel.wait()
        return caches

    def _workers(self, most: int) -> int:
        return max(1, min(self.config.runtime.workers, most))

    def _say(self, done: int, total: int, note: str) -> None:
        self.trainer.report(f"{note or 'preparing demonstrations'}, {done} of {total}")


def scene_tasks(dataset: Dataset) -> list[str]:
    """Return the tasks of the data that are defined at level train, or all such tasks if none of them is."""
    present, held_out = set(dataset.index.column("task").to_pylist()), held_out_tasks()
    tasks = [task for task in list_tasks() if task not in held_out]  # composed scenes are of none
    return sorted(present.intersection(tasks)) or tasks
