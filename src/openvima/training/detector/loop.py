"""The training loop of detectors: frames out of the shards, checkpoints, going on where a run stopped."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from openvima.data.batching import BatchOrder
from openvima.data.reader import Dataset
from openvima.detector.augment import augmented
from openvima.detector.checkpoint import load_network
from openvima.detector.config import detector_config
from openvima.detector.detectron2 import load_detectron2
from openvima.detector.frames import Frame, FrameSource, held_out_frames
from openvima.detector.network import MaskRCNN
from openvima.errors import ConfigError, DatasetError
from openvima.policies.devices import torch_threads, usable_device
from openvima.training.detector.config import DetectorTrainingConfig
from openvima.training.detector.learner import DetectorLearner, FrameBatch
from openvima.training.detector.split import split_episodes
from openvima.training.optimizer_state import load_named_state, named_state
from openvima.training.provenance import index_hash, provenance
from openvima.training.run_folder import METRICS_FILE, SESSIONS_FILE, TIMINGS_FILE, RunFolder, TrainedState
from openvima.training.schedule import learning_rate_at, step_generator, step_seed

Report = Callable[[int, int, str], None]
Metrics = dict[str, float]

LOG_EVERY = 20  # steps
VALIDATION_BATCH = 8  # frames
# Where files are, and how the work is done, does not make it another run.
_NOT_SETTINGS = ("data", "out", "device", "threads", "force", "checkpoint_every")


def train_detector(config: DetectorTrainingConfig, report: Report | None = None) -> Path:
    """Train a detector on the segmentation of demonstrations, or go on with a run that was interrupted.

    Args:
        config: All settings.
        report: Called with steps done, steps in all, and a note.

    Returns:
        The run folder; `load_detector` takes it.

    Raises:
        ConfigError: The folder holds a run with other settings, or the loss grew beyond all bounds.
        DatasetError: There are not enough demonstrations.
        CheckpointError: The last checkpoint, or the one to begin with, is damaged.
    """
    dataset = Dataset(config.data)
    training, held_out = split_episodes(dataset, config.validation_share)
    if 2 * len(training) < config.batch or not len(held_out):
        raise DatasetError(
            f"{config.data} holds {len(training)} demonstrations to learn from and {len(held_out)} for "
            f"validation; a batch of {config.batch} frames needs {config.batch // 2} and 1. Generate more, "
            "lower batch, or raise validation_share."
        )
    with torch_threads(config.threads):
        learner = DetectorLearner(_begin(config), sampled=config.sampled)
        run = RunFolder(config.out, _settings(config, learner), force=config.force)
        source = FrameSource(dataset, training, prompt_share=config.prompt_share)
        kept = FrameSource(dataset, held_out, prompt_share=config.prompt_share)
        frames = list(held_out_frames(kept, config.validation_frames, seed=config.seed))
        _Trainer(config, learner, run, source, frames, report or _ignore).train()
    return config.out


class _Trainer:
    """One run in progress."""

    def __init__(
        self,
        config: DetectorTrainingConfig,
        learner: DetectorLearner,
        run: RunFolder,
        source: FrameSource,
        held_out: Sequence[Frame],
        report: Report,
    ) -> None:
        self.config, self.learner, self.run = config, learner, run
        self.source, self.held_out, self.report = source, held_out, report
        self.order = BatchOrder(len(source), batch=config.batch // 2, seed=config.seed)
        self.started = time.monotonic()
        self.progress = run.resume(learner)
        self.device = _device(config.device)
        learner.to(self.device)
        learner.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it
        self.optimizer = _optimizer(learner, config)
        if self.progress.step:
            load_named_state(learner, self.optimizer, run.optimizer_state())
        run.go_back_to(self.progress)
        run.append(SESSIONS_FILE, {"step": self.progress.step, **provenance(source.dataset)})

    def train(self) -> None:
        """Do the steps that are left."""
        config, window = self.config, []
        for step in range(self.progress.step, config.steps):
            window.append(self._step(step))
            self.progress = replace(self.progress, step=step + 1)
            saves = (step + 1) % config.checkpoint_every == 0 or step + 1 == config.steps
            if saves or (step + 1) % LOG_EVERY == 0:
                self._log(_mean(window))
                window = []
            if saves:
                self._save()

    def _step(self, step: int) -> Metrics:
        config = self.config
        for group in self.optimizer.param_groups:
            group["lr"] = learning_rate_at(
                step, highest=config.learning_rate, steps=config.steps, warmup_steps=config.warmup_steps
            )
        self.learner.train()
        self.optimizer.zero_grad(set_to_none=True)
        loss, losses = self.learner(self._batch(step).to(self.device))
        loss.backward()
        norm = float(nn.utils.clip_grad_norm_(self.learner.parameters(), config.clip_norm))
        if not math.isfinite(norm):
            raise ConfigError(
                f"the gradient is {norm} at step {step}; lower learning_rate. The last checkpoint is from "
                "before."
            )
        self.optimizer.step()
        return {"loss": float(loss.detach()), **_numbers(losses), "gradient_norm": norm}

    def _batch(self, step: int) -> FrameBatch:
        frames = []
        for row in self.order.rows(step).tolist():
            rng = np.random.default_rng([self.config.seed, step, row])
            drawn = self.source.draw(row, rng)
            frames += [augmented(frame, rng) for frame in drawn] if self.config.augment else drawn
        return FrameBatch.of(frames, step_generator(self.config.seed, "boxes of the losses", step))

    @torch.no_grad()
    def _validate(self) -> Metrics:
        """Losses on frames that are held out, weighted by the number of frames."""
        self.learner.eval()
        totals: Metrics = {}
        for start in range(0, len(self.held_out), VALIDATION_BATCH):
            frames = self.held_out[start : start + VALIDATION_BATCH]
            generator = step_generator(self.config.seed, "boxes of the validation", start)
            loss, losses = self.learner(FrameBatch.of(frames, generator).to(self.device))
            for name, value in {"loss": float(loss), **_numbers(losses)}.items():
                totals[name] = totals.get(name, 0.0) + value * len(frames) / len(self.held_out)
        return totals

    def _save(self) -> None:
        metrics = self._validate()
        self.run.append(
            METRICS_FILE,
            {**self._place(), **{f"validation_{name}": value for name, value in metrics.items()}},
        )
        name = f"detector-{self.progress.step:06d}"
        score, best = -metrics["loss"], self.progress.best_score
        if best is None or score >= best:
            self.progress = replace(self.progress, best_score=score, best_checkpoint=name)
        state = TrainedState(self.learner.state_dict(), named_state(self.learner, self.optimizer))
        self.run.save(name, self.learner, state, self.progress)

    def _log(self, metrics: Metrics) -> None:
        self.run.append(METRICS_FILE, {**self._place(), **metrics})
        seconds = round(time.monotonic() - self.started, 2)
        self.run.append(TIMINGS_FILE, {**self._place(), "seconds_since_start": seconds})
        note = "  ".join(f"{name} {value:.3f}" for name, value in list(metrics.items())[:6])
        self.report(self.progress.step, self.config.steps, note)

    def _place(self) -> dict[str, int]:
        return {"stage": self.progress.stage, "step": self.progress.step}


def _begin(config: DetectorTrainingConfig) -> MaskRCNN:
    """The network to begin with; `init` is read in full, which also checks it."""
    if config.init is not None:
        return load_detectron2(config.init) if config.init.is_file() else load_network(config.init)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(step_seed(config.seed, "weights", 0))  # layers draw from the global generator
        return MaskRCNN(detector_config(config.preset))


def _optimizer(learner: DetectorLearner, config: DetectorTrainingConfig) -> torch.optim.Optimizer:
    """AdamW; vectors (biases, norms) do not decay."""
    parameters = list(learner.parameters())
    groups = [
        {"params": [p for p in parameters if p.ndim > 1]},
        {"params": [p for p in parameters if p.ndim <= 1], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=config.learning_rate, weight_decay=config.weight_decay)


def _settings(config: DetectorTrainingConfig, learner: DetectorLearner) -> dict[str, Any]:  # Any: YAML
    """Everything that decides the weights."""
    values = {name: value for name, value in asdict(config).items() if name not in _NOT_SETTINGS}
    if config.init is not None:
        values["init"] = str(config.init)
    demonstrations = {"index": index_hash(config.data)}
    return {"training": values, "demonstrations": demonstrations, "detector": learner.description()}


def _device(name: str) -> torch.device:
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    return usable_device(name)


def _numbers(losses: dict[str, torch.Tensor]) -> Metrics:
    return {name: float(value.detach()) for name, value in losses.items()}


def _mean(window: Sequence[Metrics]) -> Metrics:
    return {name: sum(metrics[name] for metrics in window) / len(window) for name in window[0]}


def _ignore(done: int, total: int, note: str) -> None:
    """Report to nobody."""
