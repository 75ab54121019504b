"""The training loop: stages one after the other, checkpoints, and going on where a run stopped."""

import math
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import nn

from openvima.catalog.packs import load_assets
from openvima.data.object_cache.cache import Boxes, ObjectCache, open_object_cache
from openvima.data.reader import Dataset
from openvima.detector.hooks import detected_object_cache, plugged_boxes
from openvima.errors import ConfigError
from openvima.policies.devices import torch_threads
from openvima.training.building import build_learner, resolved
from openvima.training.config import TrainingConfig
from openvima.training.inverse_dynamics import MOTION_TEXT
from openvima.training.learner import Learner, PolicyLearner
from openvima.training.optimizer_state import load_named_state, named_state
from openvima.training.parallel import (
    Parallel,
    compile_layers,
    joined,
    set_whole_state,
    whole_state,
)
from openvima.training.pretrain import Variety, render_pairs
from openvima.training.provenance import index_hash, provenance
from openvima.training.run_folder import (
    METRICS_FILE,
    SESSIONS_FILE,
    TIMINGS_FILE,
    RunFolder,
    TrainedState,
)
from openvima.training.schedule import learning_rate_at, step_seed
from openvima.training.sequence_lengths import check_lengths
from openvima.training.source import ExampleSource, check_words, split_examples, with_boxes_of
from openvima.training.stages import Cloning, Matching, Metrics, Stage, freeze_crops, has_turns, keeps_crops
from openvima.training.tensorboard import Board

Report = Callable[[int, int, str], None]
# A trial in the simulator: checkpoint folder to metrics. It is handed in, since training needs no simulation.
Rollout = Callable[[Path], Metrics]

LOG_EVERY = 20  # steps
# Where files are, and how the work is done, does not make it another run.
_NOT_SETTINGS = (
    "data",
    "out",
    "tokens",
    "t5",
    "device",
    "compile",
    "sharding",
    "loader_workers",
    "threads",
    "tensorboard",
    "force",
    "checkpoint_every",
    "keep_every",
    "rollout_every",
    "rollout_episodes",
)


def train(config: TrainingConfig, report: Report | None = None, rollout: Rollout | None = None) -> Path:
    """Train a policy on demonstrations, or go on with a run that was interrupted.

    With the same settings and number of threads an interrupted run on a processor ends with the very weights
    of one that was not. Started by `torchrun`, all its processes train together.

    Args:
        config: All settings.
        report: Called with steps done, steps in all, and a note.
        rollout: Called with a checkpoint every `config.rollout_every` steps; returns what to log.

    Returns:
        The run folder; `load_policy` takes it.

    Raises:
        ConfigError: The folder holds a run with other settings, preset and settings contradict each other, or
            there is no such detector.
        DatasetError: There are no demonstrations, or one is too long for the network.
        CheckpointError: The last checkpoint or the detector is damaged, or T5 is not where the settings say,
            or of other sizes.
        PromptError: A prompt has a word that the policy's vocabulary lacks.
        MissingExtraError: The preset reads prompts with T5, and a package for that is not installed.
    """
    config = resolved(config)
    load_assets(config.assets)  # what is wrong is found before there is a run folder
    dataset = Dataset(config.data)
    boxes = plugged_boxes(config.boxes) if config.boxes is not None else None
    with torch_threads(config.threads), joined(config.device, config.sharding) as parallel:
        learner = build_learner(config)
        if boxes and learner.input_kind == "frames":
            raise ConfigError(
                f"boxes is {config.boxes!r}, but preset {config.preset!r} sees whole frames; leave boxes "
                "out, or take a preset that sees objects."
            )
        run = RunFolder(
            config.out,
            _settings(config, dataset, learner, boxes),
            force=config.force,
            keep_every=config.keep_every,
            is_first=parallel.is_first,
        )
        parallel.wait()
        trainer = _Trainer(config, dataset, boxes, learner, run, parallel, report or _ignore, rollout)
        try:
            trainer.train()
        finally:
            trainer.board.close()
    return run.path


class _Trainer:
    """One run in progress."""

    def __init__(
        self,
        config: TrainingConfig,
        dataset: Dataset,
        boxes: Boxes | None,
        learner: Learner,
        run: RunFolder,
        parallel: Parallel,
        report: Report,
        rollout: Rollout | None,
    ) -> None:
        self.config, self.dataset, self.learner, self.run = config, dataset, learner, run
        self.boxes, self.parallel, self.report, self.rollout = boxes, parallel, report, rollout
        self.started = time.monotonic()
        self._last = (0, self.started)  # step and time of the last line of metrics
        self.progress = run.resume(learner)
        learner.to(parallel.device)
        self.module: nn.Module = learner
        self.stages: list[tuple[int, Callable[[], Stage]]] = []
        self.num_steps = 0  # until both are known, for what is reported on the way
        steps = config.steps if config.epochs is None else self._steps_of_epochs(config.epochs)
        self.stages.append((steps, self._cloning))
        if config.pretraining_steps:
            self.stages.insert(0, (config.pretraining_steps, self._matching))
        self.num_steps = sum(steps for steps, _ in self.stages)
        self.board = Board(run.path, self._done() + 1, wanted=config.tensorboard and parallel.is_first)
        if parallel.is_first:
            run.go_back_to(self.progress)
            origin = {"processes": parallel.num_ranks, **provenance(dataset)}
            run.append(SESSIONS_FILE, {**self._here(), **origin})

    def train(self) -> None:
        """Run what is left of the stages."""
        for number, (num_steps, make) in enumerate(self.stages):
            if number < self.progress.stage or (number, num_steps) == (
                self.progress.stage,
                self.progress.step,
            ):
                continue
            if number > self.progress.stage:
                self.progress = replace(self.progress, stage=number, step=0)
            self._run_stage(make(), num_steps)

    def _run_stage(self, stage: Stage, num_steps: int) -> None:
        optimizer = _optimizer(self.learner, stage, self.config)
        if self.progress.step:
            self._load_optimizer(optimizer)
        window: list[Metrics] = []
        self._last = (self.progress.step, time.monotonic())
        for step in range(self.progress.step, num_steps):
            window.append(self._step(stage, optimizer, step, num_steps))
            self.progress = replace(self.progress, step=step + 1)
            saves = self._saves_at(step + 1) or step + 1 == num_steps
            if saves or (step + 1) % LOG_EVERY == 0:
                self._log(stage, self.parallel.mean(_mean(window)))
                window = []
            if saves:
                self._save(stage, optimizer)

    def _saves_at(self, step: int) -> bool:
        """Whether a checkpoint is due, be it to go on from, to keep, or to play."""
        config = self.config
        return any(
            every and step % every == 0
            for every in (config.checkpoint_every, config.keep_every, config.rollout_every)
        )

    def _step(self, stage: Stage, optimizer: torch.optim.Optimizer, step: int, num_steps: int) -> Metrics:
        config = self.config
        rate = learning_rate_at(
            step,
            highest=stage.learning_rate,
            steps=num_steps,
            warmup_steps=config.warmup_steps,
            decay_steps=config.decay_steps,
            final=config.final_learning_rate,
        )
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        self.module.train()
        device, rank = self.parallel.device, self.parallel.rank
        purpose = f"dropout of {stage.name}" + (f" in process {rank}" if rank else "")
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(step_seed(config.seed, purpose, step))  # from it dropout draws
            metrics = stage.backward(step)
        norm = float(nn.utils.clip_grad_norm_(stage.parameters, config.clip_norm))  # of all processes
        if not math.isfinite(norm):
            raise ConfigError(
                f"the gradient is {norm} at step {step} of {stage.name}, with learning_rate {rate:g} and "
                f"precision {config.precision}; lower learning_rate, or take float32. The last checkpoint "
                "is from before."
            )
        optimizer.step()
        return {**metrics, "gradient_norm": norm}

    def _log(self, stage: Stage, metrics: Metrics) -> None:
        self._note(stage, metrics)
        if self.parallel.is_first:
            seconds = round(time.monotonic() - self.started, 2)
            self.run.append(TIMINGS_FILE, {**self._here(), "seconds_since_start": seconds})
        now, step = time.monotonic(), self.progress.step
        rate = max(0, step - self._last[0]) / max(1e-9, now - self._last[1])
        self._last = (step, now)
        note = "  ".join(f"{name} {value:.3f}" for name, value in list(metrics.items())[:3])
        self._report(f"{stage.name}: {note}  {rate:.1f} steps/s")

    def _save(self, stage: Stage, optimizer: torch.optim.Optimizer) -> None:
        """Validate, note whether it is the best, and write a checkpoint.

        With few held-out demonstrations scores are noisy, and later checkpoints have learnt at smaller rates:
        a later one counts as the best unless it is worse by more than the score's standard error.
        """
        self.module.eval()
        metrics = stage.validate()
        self._note(stage, {f"validation_{name}": value for name, value in metrics.items()})
        name = f"{stage.name}-{self.progress.step:06d}"
        is_last_stage = self.progress.stage == len(self.stages) - 1
        score, error = metrics.get("score", 0.0), metrics.get("score_error", 0.0)
        best = self.progress.best_score
        if is_last_stage and (best is None or score >= best - error):
            self.progress = replace(self.progress, best_score=max(score, best or 0.0), best_checkpoint=name)
        state = self._state(optimizer)
        if self.parallel.is_first:
            self.run.save(name, self.learner, state, self.progress)
            every = self.config.rollout_every
            if self.rollout and every and is_last_stage and self.progress.step % every == 0:
                scores = self.rollout(self.run.checkpoints / name)
                self._note(stage, {f"rollout_{key}": value for key, value in scores.items()})
        self.parallel.wait()

    def _note(self, stage: Stage, metrics: Metrics) -> None:
        if metrics and self.parallel.is_first:
            self.run.append(METRICS_FILE, {**self._here(), "name": stage.name, **metrics})
            self.board.add(stage.name, metrics, self._done())

    def _state(self, optimizer: torch.optim.Optimizer) -> TrainedState:
        if self.parallel.is_sharded:
            return TrainedState(*whole_state(self.learner, optimizer))
        return TrainedState(self.learner.state_dict(), named_state(self.learner, optimizer))

    def _load_optimizer(self, optimizer: torch.optim.Optimizer) -> None:
        state = self.run.optimizer_state()
        if self.parallel.is_sharded:
            set_whole_state(self.learner, optimizer, state)
        else:
            load_named_state(self.learner, optimizer, state)

    @cached_property
    def _tokens(self) -> list[ObjectCache]:
        """The token caches: of true boxes, of those of a detector, or first the one and then the other.

        The first process makes them if need be.
        """
        share, folder = self.config.detected_share or 0.0, self.config.tokens
        caches = []
        if not self.parallel.is_first:
            self.parallel.wait()
        if share < 1:
            kind = self.learner.input_kind
            caches.append(open_object_cache(self.dataset, kind, folder=folder, report=self._say))
        if share > 0:
            assert self.boxes is not None  # `resolved` has seen to it
            caches.append(detected_object_cache(self.dataset, self.boxes, folder=folder, report=self._say))
        if self.parallel.is_first:
            self.parallel.wait()
        return caches

    def _steps_of_epochs(self, epochs: float) -> int:
        """Steps of so many passes over what is left to learn from when some is kept for validation."""
        training, _ = self._examples
        return max(1, round(epochs * len(training) / min(self.config.batch, len(training))))

    @cached_property
    def _examples(self) -> tuple[ExampleSource, ExampleSource]:
        """What to learn from, and what is held out."""
        config = self.config
        return split_examples(
            self._tokens[0],
            validation_share=config.validation_share,
            validation_episodes=config.validation_episodes,
        )

    def _matching(self) -> Stage:
        assert isinstance(self.learner, PolicyLearner)  # `resolved` has seen to it
        tasks = sorted(set(self.dataset.index.column("task").to_pylist()))
        network, config = self.learner.network, self.config
        pairs = render_pairs(
            tasks,
            num_scenes=config.pretraining_scenes,
            seed=config.seed,
            assets=config.assets,
            variety=Variety(
                config.pretraining_random_looks,
                config.pretraining_twins,
                again=has_turns(network) or config.pretraining_twins > 0,
                grays=config.pretraining_grays,
            ),
            report=self._say,
        )
        return Matching(network, config, pairs.to(self.parallel.device))

    def _cloning(self) -> Stage:
        self._report(f"reading {len(self.dataset)} demonstrations")
        tokens, config = self._tokens, self.config
        if isinstance(self.learner, PolicyLearner):
            check_words(tokens[0], self.learner.reader)
            if config.motion_share:
                self.learner.reader.tokenizer.encode(MOTION_TEXT.format(frames=""))
            for cache in tokens:
                check_lengths(
                    cache, self.learner.network, self.learner.reader, motion_share=config.motion_share
                )
            if keeps_crops(self.learner.network, config):
                freeze_crops(self.learner, tokens)
        if config.compile:
            compile_layers(self.learner)
        self.module = self.parallel.wrap(self.learner)
        training, validation = self._examples
        detected = with_boxes_of(tokens[1], training) if len(tokens) > 1 else None
        return Cloning(self.learner, self.module, config, training, validation, self.parallel, detected)

    def _say(self, done: int, total: int, note: str) -> None:
        self._report(f"{note or 'cutting out objects'}, {done} of {total}")

    def _report(self, note: str) -> None:
        if self.parallel.is_first:
            self.report(self._done(), self.num_steps, note)

    def _here(self) -> dict[str, int]:
        return {"stage": self.progress.stage, "step": self.progress.step}

    def _done(self) -> int:
        """Steps that are done, counted through all stages."""
        return sum(steps for steps, _ in self.stages[: self.progress.stage]) + self.progress.step


def _optimizer(learner: Learner, stage: Stage, config: TrainingConfig) -> torch.optim.Optimizer:
    """AdamW; vectors (biases, norms) and tables do not decay."""
    tables = {id(m.weight) for m in learner.modules() if isinstance(m, nn.Embedding)}
    decayed = [p for p in stage.parameters if p.ndim > 1 and id(p) not in tables]
    others = [p for p in stage.parameters if p.ndim <= 1 or id(p) in tables]
    groups = [{"params": decayed}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=stage.learning_rate, weight_decay=config.weight_decay, fused=True)


def _settings(
    config: TrainingConfig, dataset: Dataset, learner: Learner, boxes: Boxes | None
) -> dict[str, Any]:  # Any: YAML
    """Everything that decides the weights: settings, network sizes, and which demonstrations there are."""
    values = {name: value for name, value in asdict(config).items() if name not in _NOT_SETTINGS}
    demonstrations = {
        "episodes": len(dataset),
        "index": index_hash(config.data),
        **({"boxes": boxes.name} if boxes else {}),
    }
    return {"training": values, "demonstrations": demonstrations, "policy": learner.description()}


def _mean(window: list[Metrics]) -> Metrics:
    return {name: sum(metrics[name] for metrics in window) / len(window) for name in window[0]}


def _ignore(done: int, total: int, note: str) -> None:
    """Report to nobody."""
