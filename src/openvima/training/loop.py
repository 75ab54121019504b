"""The training loop: stages one after the other, checkpoints, and going on where a run stopped."""

import hashlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import torch

from openvima.catalog.packs import load_assets
from openvima.data.manifest import INDEX_NAME
from openvima.data.reader import Dataset
from openvima.data.tokens.cache import open_tokens
from openvima.errors import ConfigError
from openvima.policies.config import PolicyConfig
from openvima.policies.inputs import Reader
from openvima.policies.layers.object_encoder import ObjectEncoderConfig
from openvima.policies.network import PolicyNetwork, build_network
from openvima.policies.presets import preset
from openvima.policies.t5 import load_t5, tokenizer_for
from openvima.training.config import MATCHING_STEPS, TrainingConfig
from openvima.training.dataset import read_examples, token_kind
from openvima.training.pretrain import render_pairs
from openvima.training.run_folder import METRICS_FILE, TIMINGS_FILE, RunFolder
from openvima.training.schedule import learning_rate_share, step_seed
from openvima.training.stages import Cloning, Matching, Metrics, Stage

Report = Callable[[int, int, str], None]

LOG_EVERY = 20  # steps
# Where files are, with how many threads it runs and how often it saves does not make it another run.
_NOT_SETTINGS = ("data", "out", "tokens", "t5", "threads", "force", "checkpoint_every")


def train(config: TrainingConfig, report: Report | None = None) -> Path:
    """Train a policy on demonstrations, or go on with a run that was interrupted.

    With the same settings and number of threads an interrupted run ends with the very weights of one that was
    not.

    Args:
        config: All settings.
        report: Called with steps done, steps in all, and a note.

    Returns:
        The run folder; `load_policy` takes it.

    Raises:
        ConfigError: The folder holds a run with other settings, or preset and settings contradict each other.
        DatasetError: There are no demonstrations.
        CheckpointError: The last checkpoint is damaged, or T5 is not where the settings say, or of other
            sizes.
        MissingExtraError: The preset reads prompts with T5, and a package for that is not installed.
    """
    sizes = preset(config.preset)
    config = _resolved(config, sizes)
    load_assets(config.assets)  # what is wrong is found before there is a run folder
    dataset = Dataset(config.data)
    reader = Reader.of(sizes.images, tokenizer_for(sizes.prompt, config.t5))
    with _threads(config.threads):
        model = build_network(sizes, seed=step_seed(config.seed, "weights", 0))
        if config.t5:
            load_t5(model, config.t5)
        run = RunFolder(config.out, _settings(config, dataset), force=config.force)
        _Trainer(config, dataset, model, reader, run, report or _ignore).train()
    return run.path


def _resolved(config: TrainingConfig, sizes: PolicyConfig) -> TrainingConfig:
    """Fill in what the settings leave to the preset, and check that both fit together."""
    reads_with_t5, images = sizes.prompt.tokenizer == "t5", sizes.images
    if reads_with_t5 and config.t5 is None:
        raise ConfigError(
            f"preset {config.preset!r} reads prompts with T5; set t5 to the folder that holds it, or to "
            "'t5-base' to fetch that from the Hugging Face Hub, or take nano or another preset of that size."
        )
    if config.t5 is not None and not reads_with_t5:
        raise ConfigError(f"preset {config.preset!r} has its own words and no T5; leave t5 out.")
    has_appearance = isinstance(images, ObjectEncoderConfig) and images.appearance_width
    if config.pretraining_steps and not has_appearance:
        raise ConfigError(
            f"pretraining_steps is {config.pretraining_steps}, but preset {config.preset!r} has no "
            "appearance embedding to match prompt and scene with; leave it out, or set it to 0."
        )
    if config.pretraining_steps is None:
        return replace(config, pretraining_steps=MATCHING_STEPS if has_appearance else 0)
    return config


class _Trainer:
    """One run in progress."""

    def __init__(
        self,
        config: TrainingConfig,
        dataset: Dataset,
        model: PolicyNetwork,
        reader: Reader,
        run: RunFolder,
        report: Report,
    ) -> None:
        self.config, self.dataset, self.model, self.reader = config, dataset, model, reader
        self.run, self.report = run, report
        self.started = time.monotonic()
        self.progress = run.resume(model)
        self.stages = [(config.steps, self._cloning)]
        if config.pretraining_steps:
            self.stages.insert(0, (config.pretraining_steps, self._matching))
        self.num_steps = sum(steps for steps, _ in self.stages)

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
        optimizer = _optimizer(self.model, stage, self.config)
        if self.progress.step:
            self.run.resume_optimizer(optimizer)
        window: list[Metrics] = []
        for step in range(self.progress.step, num_steps):
            window.append(self._step(stage, optimizer, step, num_steps))
            self.progress = replace(self.progress, step=step + 1)
            saves = (step + 1) % self.config.checkpoint_every == 0 or step + 1 == num_steps
            if saves or (step + 1) % LOG_EVERY == 0:
                self._log(stage, _mean(window))
                window = []
            if saves:
                self._save(stage, optimizer)

    def _step(self, stage: Stage, optimizer: torch.optim.Optimizer, step: int, num_steps: int) -> Metrics:
        share = learning_rate_share(step, steps=num_steps, warmup_steps=self.config.warmup_steps)
        for group in optimizer.param_groups:
            group["lr"] = stage.learning_rate * share
        optimizer.zero_grad(set_to_none=True)
        self.model.train()
        with torch.random.fork_rng(devices=[]):  # dropout draws from torch's global generator
            torch.manual_seed(step_seed(self.config.seed, f"dropout of {stage.name}", step))
            metrics = stage.backward(step)
        torch.nn.utils.clip_grad_norm_(stage.parameters, self.config.clip_norm)
        optimizer.step()
        return metrics

    def _log(self, stage: Stage, metrics: Metrics) -> None:
        here = {"stage": self.progress.stage, "step": self.progress.step}
        self.run.append(METRICS_FILE, {**here, "name": stage.name, **metrics})
        seconds = round(time.monotonic() - self.started, 2)
        self.run.append(TIMINGS_FILE, {**here, "seconds_since_start": seconds})
        note = "  ".join(f"{name} {value:.3f}" for name, value in list(metrics.items())[:3])
        self._report(f"{stage.name}: {note}")

    def _save(self, stage: Stage, optimizer: torch.optim.Optimizer) -> None:
        """Validate, note whether it is the best, and write a checkpoint.

        With few held-out demonstrations scores are noisy, and later checkpoints have learnt at smaller rates:
        a later one counts as the best unless it is worse by more than the score's standard error.
        """
        self.model.eval()
        metrics = stage.validate()
        if metrics:
            here = {"stage": self.progress.stage, "step": self.progress.step}
            names = {f"validation_{name}": value for name, value in metrics.items()}
            self.run.append(METRICS_FILE, {**here, "name": stage.name, **names})
        name = f"{stage.name}-{self.progress.step:06d}"
        is_last_stage = self.progress.stage == len(self.stages) - 1
        score, error = metrics.get("score", 0.0), metrics.get("score_error", 0.0)
        best = self.progress.best_score
        if is_last_stage and (best is None or score >= best - error):
            self.progress = replace(self.progress, best_score=max(score, best or 0.0), best_checkpoint=name)
        self.run.save(name, self.model, optimizer, self.progress, self.reader.tokenizer)

    def _matching(self) -> Stage:
        tasks = sorted(set(self.dataset.index.column("task").to_pylist()))
        num_scenes, assets = self.config.pretraining_scenes, self.config.assets
        pairs = render_pairs(
            tasks, num_scenes=num_scenes, seed=self.config.seed, assets=assets, report=self._say
        )
        return Matching(self.model, self.config, pairs)

    def _cloning(self) -> Stage:
        self._report(f"reading {len(self.dataset)} demonstrations")
        tokens = open_tokens(
            self.dataset, token_kind(self.reader), folder=self.config.tokens, report=self._say
        )
        examples = read_examples(tokens, self.reader, validation_share=self.config.validation_share)
        return Cloning(self.model, self.config, examples, self.reader)

    def _say(self, done: int, total: int, note: str) -> None:
        self._report(f"{note or 'cutting out objects'}, {done} of {total}")

    def _report(self, note: str) -> None:
        before = sum(steps for steps, _ in self.stages[: self.progress.stage])
        self.report(before + self.progress.step, self.num_steps, note)


def _optimizer(model: PolicyNetwork, stage: Stage, config: TrainingConfig) -> torch.optim.Optimizer:
    """AdamW; vectors (biases, norms) and tables do not decay."""
    tables = {id(m.weight) for m in model.modules() if isinstance(m, torch.nn.Embedding)}
    decayed = [p for p in stage.parameters if p.ndim > 1 and id(p) not in tables]
    others = [p for p in stage.parameters if p.ndim <= 1 or id(p) in tables]
    groups = [{"params": decayed}, {"params": others, "weight_decay": 0.0}]
    return torch.optim.AdamW(groups, lr=stage.learning_rate, weight_decay=config.weight_decay, fused=True)


def _settings(config: TrainingConfig, dataset: Dataset) -> dict[str, Any]:  # Any: plain YAML values
    """Everything that decides the weights: settings, network sizes, and which demonstrations there are."""
    index = hashlib.blake2b((config.data / INDEX_NAME).read_bytes(), digest_size=16).hexdigest()
    values = {name: value for name, value in asdict(config).items() if name not in _NOT_SETTINGS}
    demonstrations = {"episodes": len(dataset), "index": index}
    return {"training": values, "demonstrations": demonstrations, "policy": preset(config.preset).to_dict()}


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _mean(window: list[Metrics]) -> Metrics:
    return {name: sum(metrics[name] for metrics in window) / len(window) for name in window[0]}


def _ignore(done: int, total: int, note: str) -> None:
    """Report to nobody."""
