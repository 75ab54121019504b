"""The training loop: stages in turn, metrics, checkpoints, and exact resuming.

Contrastive pretraining, behaviour cloning and the training of detectors are stages of this one loop. A stage
computes gradients; the loop does the rest. All random numbers are derived from the step.
"""

import hashlib
import logging
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import nn

from openvima.atomic_io import folder_lock
from openvima.data.manifest import INDEX_NAME
from openvima.data.reader import Dataset
from openvima.errors import ConfigError, Terminated
from openvima.multiprocess import Report
from openvima.policies.base import torch_threads
from openvima.policies.naming import METRICS_FILE
from openvima.training.config import RunConfig, ScheduleConfig
from openvima.training.learner import Learner
from openvima.training.parallel import Parallel, join_processes, load_named_state, named_state
from openvima.training.run_folder import SESSIONS_FILE, TIMINGS_FILE, RunFolder, provenance
from openvima.training.trackers import Tracker, open_trackers
from openvima.video.encoder import Animation


def learning_rate_at(step: int, schedule: ScheduleConfig, *, peak: float, num_steps: int) -> float:
    """Return the learning rate of a step: linear warm-up, cosine decay, then constant.

    Args:
        step: Steps done, from 0.
        schedule: Its warm-up counts up to a third of the run, its decay up to the end of the run, its final
            rate up to the peak.
        peak: Learning rate after the warm-up.
        num_steps: Steps of the whole run.
    """
    warmup_steps = min(schedule.warmup_steps, num_steps // 3)
    if step < warmup_steps:
        return peak * (step + 1) / (warmup_steps + 1)
    left = max(1, num_steps - warmup_steps)
    progress = min(1.0, (step - warmup_steps) / min(left, schedule.decay_steps or left))
    final = min(schedule.final_learning_rate, peak)
    return final + (peak - final) * 0.5 * (1 + math.cos(math.pi * progress))


def step_seed(seed: int, purpose: str, step: int) -> int:
    """Return the seed of one purpose at one step, so that a resumed run needs no saved generators."""
    digest = hashlib.blake2b(f"{seed}/{purpose}/{step}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def step_generator(seed: int, purpose: str, step: int) -> torch.Generator:
    """Return a generator seeded by `step_seed`."""
    return torch.Generator().manual_seed(step_seed(seed, purpose, step))


def _raise_terminated(number: int, frame: object) -> None:
    raise Terminated


@contextmanager
def exchange_sigterm(old: object, new: Callable[[int, object], None]) -> Iterator[None]:
    """Handle SIGTERM otherwise within the block.

    In another thread than the main one, and where another handler than the old one is set, as by the caller's
    program, it acts as outside of the block.
    """
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGTERM) != old:
        yield
        return
    before = signal.signal(signal.SIGTERM, new)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def open_run(config: RunConfig) -> Iterator[Parallel]:
    """Join the processes of a run; the first of them holds the lock of its folder.

    Raises:
        ConfigError: There is no such device.
        FolderLockedError: Another run writes to the folder.
    """
    with (
        torch_threads(config.runtime.threads),
        join_processes(config.runtime.device) as parallel,
        # As with Ctrl-C workers and files end. Not while processes join, a wait that no handler interrupts.
        exchange_sigterm(signal.SIG_DFL, _raise_terminated),
        folder_lock(config.out) if parallel.is_first else nullcontext(),
    ):
        yield parallel


Metrics = dict[str, float]
# From a checkpoint folder to metrics. It is passed in, since training does not import the simulator.
Rollout = Callable[[Path], Metrics]
Animate = Callable[[Path], Sequence[Animation]]

LOG_EVERY = 20  # steps
COLLAPSED_SPREAD = 0.02  # see `openvima.policies.nn.action_head.spread`
OVERFIT_GAP = 0.15  # of the score in training to that on held-out demonstrations

logger = logging.getLogger(__name__)
# What the terminal shows of the metrics.
_LABELS = {
    "loss": "loss",
    "pick_accuracy": "pick",
    "object_accuracy": "object",
    "place_accuracy": "place",
    "rotation_accuracy": "rotation",
    "yaw_accuracy": "rotation",
    "contrastive_accuracy": "retrieval",
    "retrieval_accuracy": "retrieval",
}


class Stage(Protocol):
    """A loss that is minimised for a number of steps.

    Attributes:
        name: Used in file names and metrics; names sort in the order of the stages.
        learning_rate: Peak learning rate.
        parameters: The trained parameters.
    """

    name: str
    learning_rate: float
    parameters: list[nn.Parameter]

    def backward(self, step: int) -> Metrics:
        """Add the gradients of one step; return "loss", its parts as "loss/NAME", and other metrics."""
        ...

    def validate(self) -> Metrics:
        """Return metrics on held-out data: "score" (larger is better), and optionally "score_error"."""
        ...


PlannedStage = tuple[int, Callable[[], Stage]]
"""The number of steps of a stage, and the function that builds it when it starts."""


def num_steps(schedule: ScheduleConfig, num_examples: Callable[[], int], batch_size: int) -> int:
    """Return the number of steps of a run, computed from epochs if they are set."""
    if schedule.epochs is None:
        return schedule.steps
    count = num_examples()
    return max(1, round(schedule.epochs * count / min(batch_size, count)))


class Trainer:
    """One run in progress.

    Args:
        config: All settings.
        dataset: The demonstrations.
        learner: The trained module; a resumed run loads its weights.
        parallel: The processes of the run.
        report: Called with the progress.
        rollout: Called with checkpoints of the last stage.
        rollout_every: Steps between rollouts.
        animate: Called with the same checkpoints, for experiment trackers.
        demonstrations: Further values that identify the data.

    Raises:
        InputFileError: The last checkpoint is damaged.
        ConfigError: The folder holds a run with other settings.
    """

    def __init__(
        self,
        config: RunConfig,
        dataset: Dataset,
        learner: Learner,
        parallel: Parallel,
        *,
        report: Report | None = None,
        rollout: Rollout | None = None,
        rollout_every: int | None = None,
        animate: Animate | None = None,
        demonstrations: dict[str, Any] | None = None,
    ) -> None:
        self.config, self.dataset, self.learner, self.parallel = config, dataset, learner, parallel
        self._on_report, self._rollout, self._rollout_every = report, rollout, rollout_every
        self._animate, self._trackers = animate, list[Tracker]()
        index = (dataset.path / INDEX_NAME).read_bytes()
        data = {
            "episodes": len(dataset),
            "index": hashlib.blake2b(index, digest_size=16).hexdigest(),
            **(demonstrations or {}),
        }
        self.run = RunFolder(
            config,
            {"training": config.identity(), "demonstrations": data, "network": learner.description()},
            is_first=parallel.is_first,
        )
        parallel.wait()
        self._started, self._cpu_started = time.monotonic(), time.process_time()
        self._last = (0, self._started)  # step and time of the last line of metrics
        self._training_score = math.nan
        self.progress = self.run.resume(learner)
        learner.to(parallel.device)
        self._stages: Sequence[PlannedStage] = ()

    def train(self, stages: Sequence[PlannedStage]) -> Path:
        """Run the remaining stages, and return the run folder.

        Raises:
            ConfigError: The loss diverged.
        """
        self._stages = stages
        try:
            if self.parallel.is_first:
                self._trackers = open_trackers(self.config, self.run.path, self._done() + 1)
                self.run.rewind_to(self.progress)
                origin = {"processes": self.parallel.num_ranks, **provenance(self.dataset)}
                self.run.append(SESSIONS_FILE, {**self._here(), **origin})
                self._log_times()
            for number in range(self.progress.stage, len(stages)):
                if number > self.progress.stage:
                    self.progress = replace(self.progress, stage=number, step=0)
                num_steps, make = stages[number]
                if self.progress.step < num_steps:
                    self._run_stage(make(), num_steps)
        finally:
            for tracker in self._trackers:
                tracker.close()
        return self.run.path

    def report(self, note: str) -> None:
        """Report the progress with a note."""
        if self._on_report and self.parallel.is_first:
            self._on_report(self._done(), sum(num_steps for num_steps, _ in self._stages), note)

    def _run_stage(self, stage: Stage, num_steps: int) -> None:
        """Take the remaining steps of a stage; after a SIGTERM write a checkpoint and stop."""
        optimizer = _optimizer(self.learner, stage, self.config.optimizer.weight_decay)
        if self.progress.step:
            load_named_state(self.learner, optimizer, self.run.optimizer_state())
        self._last = (self.progress.step, time.monotonic())
        schedule = self.config.schedule
        # Checkpoints are due at multiples of these, and at the end.
        periods = [*filter(None, (schedule.checkpoint_every, schedule.keep_every, self._rollout_every))]
        sigterms: list[int] = []
        with exchange_sigterm(_raise_terminated, lambda number, frame: sigterms.append(number)):
            window: list[Metrics] = []
            for step in range(self.progress.step, num_steps):
                window.append(self._step(stage, optimizer, step, num_steps))
                self.progress = replace(self.progress, step=step + 1)
                saves = step + 1 == num_steps or any((step + 1) % every == 0 for every in periods)
                logs = saves or (step + 1) % LOG_EVERY == 0
                # Several processes stop after the same step, and so ask each other, when they log anyway.
                may_end = logs or self.parallel.num_ranks == 1
                ends = may_end and self.parallel.mean({"ends": float(bool(sigterms))})["ends"] > 0
                if logs or ends:
                    self._log(stage, self.parallel.mean(_mean(window)))
                    window = []
                if saves or ends:
                    self._save(stage, optimizer, validates=saves)
                if ends:
                    raise Terminated

    def _step(self, stage: Stage, optimizer: torch.optim.Optimizer, step: int, num_steps: int) -> Metrics:
        config = self.config
        rate = learning_rate_at(step, config.schedule, peak=stage.learning_rate, num_steps=num_steps)
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        self.learner.train()
        device, rank = self.parallel.device, self.parallel.rank
        purpose = f"dropout of {stage.name}" + (f" in process {rank}" if rank else "")
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(step_seed(config.seed, purpose, step))  # for dropout
            metrics = stage.backward(step)
        norm = nn.utils.clip_grad_norm_(
            stage.parameters, config.optimizer.max_grad_norm
        )  # over all processes
        if not math.isfinite(norm):
            raise ConfigError(
                f"the gradient is {norm:g} at step {step} of {stage.name}, with learning rate {rate:g} and "
                f"precision {config.runtime.precision}; lower optimizer.learning_rate, or take float32. The "
                "last checkpoint is from before."
            )
        optimizer.step()
        return {**metrics, "gradient_norm": float(norm), "learning_rate": rate}

    def _log(self, stage: Stage, metrics: Metrics) -> None:
        self._write(stage, metrics)
        if self.parallel.is_first:
            self._log_times()
        now, step = time.monotonic(), self.progress.step
        rate = max(0, step - self._last[0]) / max(1e-9, now - self._last[1])
        self._last = (step, now)
        self.report(f"{stage.name}: {_format(metrics)}  {rate:.1f} steps/s")
        self._training_score = metrics.get(self.learner.score, math.nan)
        if metrics.get("query_spread", 1.0) < COLLAPSED_SPREAD and self.parallel.is_first:
            logger.warning(
                "step %d: the network gives almost one action for all inputs (spread of the action query "
                "%.3f). It rarely recovers; start again with a lower optimizer.learning_rate.",
                step,
                metrics["query_spread"],
            )

    def _log_times(self) -> None:
        seconds = round(time.monotonic() - self._started, 2)
        cpu_seconds = round(time.process_time() - self._cpu_started, 2)
        times = {"seconds_since_start": seconds, "cpu_seconds_since_start": cpu_seconds}
        self.run.append(TIMINGS_FILE, {**self._here(), **times})

    def _save(self, stage: Stage, optimizer: torch.optim.Optimizer, *, validates: bool = True) -> None:
        """Validate, update the best checkpoint, and write one; without validation, the best stays.

        A later checkpoint, trained at a lower rate, is the best unless its noisy score is worse by more than
        the standard error.
        """
        self.learner.eval()
        metrics = stage.validate() if validates else {}
        self._write(stage, {f"validation_{name}": value for name, value in metrics.items()})
        if metrics and self.parallel.is_first:
            self._say_validation(stage, metrics)
        name = f"{stage.name}-{self.progress.step:06d}"
        is_last_stage = self.progress.stage == len(self._stages) - 1
        score, error = metrics.get("score", 0.0), metrics.get("score_error", 0.0)
        best = self.progress.best_score
        if validates and is_last_stage and (best is None or score >= best - error):
            best = score if best is None else max(score, best)
            self.progress = replace(self.progress, best_score=best, best_checkpoint=name)
        if self.parallel.is_first:
            self.run.save(name, self.learner, named_state(self.learner, optimizer), self.progress)
            every = self._rollout_every
            if self._rollout and every and is_last_stage and self.progress.step % every == 0:
                scores = self._rollout(self.run.checkpoints / name)
                self._write(stage, {f"rollout_{key}": value for key, value in scores.items()})
                if self._animate and self._trackers:
                    animations = self._animate(self.run.checkpoints / name)
                    for tracker in self._trackers:
                        tracker.add_animations(stage.name, animations, self._done())
        self.parallel.wait()

    def _say_validation(self, stage: Stage, metrics: Metrics) -> None:
        step, name = self.progress.step, self.learner.score
        score = metrics.get(name, math.nan)
        logger.info("%s, step %d, held out: %s", stage.name, step, _format(metrics))
        best = self.progress.best_score  # so far
        # A gap alone may come of inverse dynamics, which is easier and in training alone.
        if best is not None and score <= best and self._training_score - score > OVERFIT_GAP:
            logger.warning(
                "step %d: %s is %.0f%% in training and %.0f%% on held-out demonstrations, where it gains "
                "nothing more: the network overfits. More demonstrations or augmentation help; a longer "
                "training does not.",
                step,
                name,
                100 * self._training_score,
                100 * score,
            )

    def _write(self, stage: Stage, metrics: Metrics) -> None:
        """Append metrics to `metrics.jsonl`, and to the experiment trackers."""
        if metrics and self.parallel.is_first:
            self.run.append(METRICS_FILE, {**self._here(), "name": stage.name, **metrics})
            numbers = {name: value for name, value in metrics.items() if isinstance(value, int | float)}
            for tracker in self._trackers:
                tracker.add(stage.name, numbers, self._done())

    def _here(self) -> dict[str, int]:
        return {"stage": self.progress.stage, "step": self.progress.step}

    def _done(self) -> int:
        """Return the steps done, counted through all stages."""
        done = sum(num_steps for num_steps, _ in self._stages[: self.progress.stage])
        return done + self.progress.step


def _optimizer(learner: Learner, stage: Stage, weight_decay: float) -> torch.optim.Optimizer:
    """Build AdamW; biases, norms and embedding tables have no weight decay."""
    tables = {id(m.weight) for m in learner.modules() if isinstance(m, nn.Embedding)}
    decayed = [p for p in stage.parameters if p.ndim > 1 and id(p) not in tables]
    others = [p for p in stage.parameters if p.ndim <= 1 or id(p) in tables]
    groups = [{"params": decayed}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=stage.learning_rate, weight_decay=weight_decay, fused=True)


def _format(metrics: Metrics) -> str:
    shown = {label: metrics[name] for name, label in _LABELS.items() if name in metrics}
    return "  ".join(f"{n} {v:.2f}" if n == "loss" else f"{n} {v:.0%}" for n, v in shown.items())


def _mean(window: Sequence[Metrics]) -> Metrics:
    """Average each metric over the steps that have it."""
    names = dict.fromkeys(name for metrics in window for name in metrics)
    values = {name: [metrics[name] for metrics in window if name in metrics] for name in names}
    return {name: sum(found) / len(found) for name, found in values.items()}
