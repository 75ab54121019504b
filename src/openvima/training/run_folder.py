"""The folder of a training run: its settings, metrics and checkpoints, whole at every moment.

    RUN/config.yaml                                   settings, resolved
    RUN/metrics.jsonl                                 one line of metrics every few steps
    RUN/timings_log.jsonl                             when they were reached; differs between machines
    RUN/checkpoints/2-cloning-000400/model.safetensors, config.yaml, optimizer.safetensors, state.json
    RUN/checkpoints/best.txt                          name of the best checkpoint

Every file and checkpoint is written under a temporary name and renamed when it is whole.
"""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from openvima.errors import CheckpointError, ConfigError
from openvima.files import write_whole
from openvima.policies.base import BEST_FILE, CHECKPOINTS_FOLDER, WEIGHTS_FILE
from openvima.policies.checkpoint import load_weights, write_checkpoint
from openvima.policies.network import PolicyNetwork
from openvima.policies.tokenizer import Tokenizer

CONFIG_FILE = "config.yaml"
METRICS_FILE = "metrics.jsonl"
TIMINGS_FILE = "timings_log.jsonl"
OPTIMIZER_FILE = "optimizer.safetensors"
STATE_FILE = "state.json"
_PARTIAL = ".partial"


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a run has come.

    Args:
        stage: Number of the stage, from 0.
        step: Steps of it that are done.
        best_score: Best validation score so far; None before the first.
        best_checkpoint: Name of the checkpoint to use.
    """

    stage: int = 0
    step: int = 0
    best_score: float | None = None
    best_checkpoint: str = ""


class RunFolder:
    """Reads and writes one run.

    Args:
        path: The folder; it is made if it does not exist.
        settings: Plain values that decide the run.
        force: Throw away what is there if it belongs to other settings.

    Raises:
        ConfigError: The folder belongs to a run with other settings.
    """

    def __init__(self, path: Path, settings: dict[str, Any], *, force: bool = False) -> None:
        self.path = path
        self.checkpoints = path / CHECKPOINTS_FOLDER
        differing = self._differences(settings)
        if differing and not force:
            raise ConfigError(
                f"{path} holds a run with other settings: {'; '.join(differing)}. Give the same settings to "
                "continue it, another --out, or --force to throw it away."
            )
        if differing:
            self._clear()
        self.checkpoints.mkdir(parents=True, exist_ok=True)
        for leftover in self.checkpoints.glob(f"*{_PARTIAL}"):
            shutil.rmtree(leftover)
        write_whole(path / CONFIG_FILE, yaml.safe_dump(settings, sort_keys=False))

    def latest(self) -> Path | None:
        """Return the last whole checkpoint, or None if there is none."""
        found = sorted(path for path in self.checkpoints.iterdir() if path.is_dir())
        return found[-1] if found else None

    def save(
        self,
        name: str,
        model: PolicyNetwork,
        optimizer: torch.optim.Optimizer,
        progress: Progress,
        tokenizer: Tokenizer | None = None,
    ) -> None:
        """Write a checkpoint and delete those that are neither the latest nor the best.

        Args:
            name: Name of the checkpoint's folder; later ones sort behind earlier ones.
            model: The network.
            optimizer: Its optimizer.
            progress: How far the run has come.
            tokenizer: Stored beside the weights if the network reads prompts with that of T5.
        """
        partial = self.checkpoints / f"{name}{_PARTIAL}"
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        write_checkpoint(model, partial, tokenizer)
        save_file(_optimizer_tensors(optimizer), partial / OPTIMIZER_FILE)
        state = {field: getattr(progress, field) for field in Progress.__slots__}
        (partial / STATE_FILE).write_text(json.dumps(state), encoding="utf-8")
        final = self.checkpoints / name
        shutil.rmtree(final, ignore_errors=True)
        partial.rename(final)
        if progress.best_checkpoint:
            write_whole(self.checkpoints / BEST_FILE, progress.best_checkpoint)
        for other in self.checkpoints.iterdir():
            if other.is_dir() and other.name not in (name, progress.best_checkpoint):
                shutil.rmtree(other)

    def resume(self, model: PolicyNetwork) -> Progress:
        """Load the weights of the last checkpoint, if there is one, and forget what was logged after it.

        Returns:
            How far the run had come.

        Raises:
            CheckpointError: The checkpoint is damaged or does not fit.
        """
        checkpoint = self.latest()
        progress = _read_progress(checkpoint) if checkpoint else Progress()
        if checkpoint:
            file = checkpoint / WEIGHTS_FILE
            load_weights(model, _read_tensors(file), source=str(file))
        self._forget_after(progress)
        return progress

    def resume_optimizer(self, optimizer: torch.optim.Optimizer) -> None:
        """Load the optimizer's state from the last checkpoint.

        Raises:
            CheckpointError: There is none, or it is damaged.
        """
        checkpoint = self.latest()
        if checkpoint is None:
            raise CheckpointError(f"{self.checkpoints} holds no checkpoint to go on from.")
        values: dict[int, dict[str, torch.Tensor]] = {}
        for key, tensor in _read_tensors(checkpoint / OPTIMIZER_FILE).items():
            index, _, name = key.partition(".")
            values.setdefault(int(index), {})[name] = tensor
        optimizer.load_state_dict({**optimizer.state_dict(), "state": values})

    def append(self, file: str, values: dict[str, Any]) -> None:
        """Add one line to `METRICS_FILE` or `TIMINGS_FILE`."""
        with (self.path / file).open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(values) + "\n")

    def _forget_after(self, progress: Progress) -> None:
        """Drop the metrics of steps that come after a checkpoint, since they are going to be repeated."""
        file = self.path / METRICS_FILE
        if not file.is_file():
            return
        kept = []
        for line in file.read_text(encoding="utf-8").splitlines():
            try:
                values = json.loads(line)
            except json.JSONDecodeError:  # the last line of an interrupted run
                continue
            if (values["stage"], values["step"]) <= (progress.stage, progress.step):
                kept.append(line + "\n")
        write_whole(file, "".join(kept))

    def _differences(self, settings: dict[str, Any]) -> list[str]:
        file = self.path / CONFIG_FILE
        if not file.is_file():
            if self.path.is_dir() and any(self.path.iterdir()):
                return [f"it is not empty and has no {CONFIG_FILE}"]
            return []
        try:
            old = yaml.safe_load(file.read_text(encoding="utf-8"))
        except yaml.YAMLError:
            return [f"its {CONFIG_FILE} is no valid YAML"]
        old, new = _flattened(old), _flattened(settings)
        names = [name for name in {**old, **new} if old.get(name) != new.get(name)]
        return [f"{name} is {old.get(name)!r} there and {new.get(name)!r} here" for name in names]

    def _clear(self) -> None:
        if not (self.path / CONFIG_FILE).is_file():
            raise ConfigError(f"{self.path} holds other files and no training run; give another --out.")
        shutil.rmtree(self.checkpoints, ignore_errors=True)
        for name in (METRICS_FILE, TIMINGS_FILE, CONFIG_FILE):
            (self.path / name).unlink(missing_ok=True)


def _read_progress(checkpoint: Path) -> Progress:
    file = checkpoint / STATE_FILE
    try:
        return Progress(**json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise CheckpointError(f"{file} cannot be read ({error}); delete {checkpoint}.") from error


def _read_tensors(file: Path) -> dict[str, torch.Tensor]:
    try:
        return load_file(file)
    except (OSError, SafetensorError) as error:
        raise CheckpointError(
            f"{file} cannot be read ({error}); delete {file.parent} and repeat the command."
        ) from error


def _optimizer_tensors(optimizer: torch.optim.Optimizer) -> dict[str, torch.Tensor]:
    return {
        f"{index}.{name}": tensor.contiguous()
        for index, values in optimizer.state_dict()["state"].items()
        for name, tensor in values.items()
    }


def _flattened(values: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(values, dict):
        return {prefix: values}
    result: dict[str, Any] = {}
    for name, value in values.items():
        result |= _flattened(value, f"{prefix}.{name}" if prefix else str(name))
    return result
