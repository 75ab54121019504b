"""The folder of a training run: settings, metrics and checkpoints, consistent at any moment.

    RUN/config.yaml                                   settings, resolved
    RUN/metrics.jsonl                                 one line of metrics every few steps
    RUN/timings_log.jsonl                             when steps were reached
    RUN/sessions_log.jsonl                            versions, git commit and data of each start
    RUN/tensorboard_log/, wandb_log/                  metrics and rollouts for experiment trackers
    RUN/checkpoints/2-cloning-000400/model.safetensors, config.yaml, optimizer.safetensors, state.json
    RUN/checkpoints/best.txt                          name of the best checkpoint

Files and checkpoints are written under a temporary name and renamed when complete.
"""

import hashlib
import json
import shutil
import subprocess
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

import openvima
from openvima.atomic_io import (
    atomic_write_file,
    is_lock_file,
    naming,
    remove_stale,
    sync_file,
    sync_files,
)
from openvima.data.manifest import MANIFEST_NAME
from openvima.data.reader import Dataset
from openvima.errors import ConfigError, InputFileError, differences
from openvima.imports import versions_of
from openvima.input_files import read_json, read_yaml
from openvima.policies.naming import (
    BEST_FILE,
    CHECKPOINTS_FOLDER,
    CONFIG_FILE,
    METRICS_FILE,
    checkpoint_order,
)
from openvima.policies.tensor_files import read_safetensors, write_safetensors
from openvima.training.config import RunConfig, flatten
from openvima.training.learner import Learner
from openvima.training.trackers import BOARD_FOLDER, WANDB_FOLDER

TIMINGS_FILE = "timings_log.jsonl"
SESSIONS_FILE = "sessions_log.jsonl"
OPTIMIZER_FILE = "optimizer.safetensors"
STATE_FILE = "state.json"
_PARTIAL = ".partial"


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of a run.

    Args:
        stage: Index of the stage.
        step: Steps of the stage done.
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
        config: Its `out`, the folder, is created if missing; `force` deletes a run with other settings.
        settings: Plain values that identify the run.
        is_first: Whether this process writes the folder; others only read.

    Raises:
        ConfigError: The folder belongs to a run with other settings.
    """

    def __init__(self, config: RunConfig, settings: dict[str, Any], *, is_first: bool) -> None:
        self.path, self._keep_every = config.out, config.schedule.keep_every
        path, self.checkpoints = self.path, self.path / CHECKPOINTS_FOLDER
        if not is_first:
            return
        differing = self._differences(settings)
        if differing and not config.force:
            raise ConfigError(
                f"{path} holds a run with other settings: {'; '.join(differing)}. Give the same settings to "
                f"continue it, --init-from {path} and another --out to begin with its weights, or --force to "
                "delete it."
            )
        if differing:
            for folder in (self.checkpoints, path / BOARD_FOLDER, path / WANDB_FOLDER):
                shutil.rmtree(folder, ignore_errors=True)
            for name in (METRICS_FILE, TIMINGS_FILE, SESSIONS_FILE, CONFIG_FILE):
                (path / name).unlink(missing_ok=True)
        # First, since a folder without it, perhaps of a run that was killed at once, is refused.
        atomic_write_file(path / CONFIG_FILE, yaml.safe_dump(settings, sort_keys=False))
        self.checkpoints.mkdir(parents=True, exist_ok=True)
        for leftover in self.checkpoints.glob(f"*{_PARTIAL}"):
            shutil.rmtree(leftover)
        remove_stale(self.checkpoints)

    def latest(self) -> Path | None:
        """Return the last complete checkpoint, or None."""
        found = (path for path in self.checkpoints.iterdir() if path.is_dir())
        return max(found, key=checkpoint_order, default=None)

    def save(
        self,
        name: str,
        learner: Learner,
        optimizer: Mapping[str, Mapping[str, torch.Tensor]],
        progress: Progress,
    ) -> None:
        """Write a checkpoint, and delete others except the best and permanent ones.

        Args:
            name: Folder name, STAGE-STEP.
            learner: Writes its weights.
            optimizer: State of the optimizer, by name of the parameter.
            progress: Progress of the run.
        """
        final = self.checkpoints / name
        partial = self.checkpoints / f"{name}{_PARTIAL}"
        shutil.rmtree(partial, ignore_errors=True)
        with naming(final, partial):
            partial.mkdir()
            learner.write(partial)
            tensors = {
                f"{parameter}|{name}": tensor.detach().cpu().contiguous()
                for parameter, values in optimizer.items()
                for name, tensor in values.items()
            }
            write_safetensors(tensors, partial / OPTIMIZER_FILE)
            atomic_write_file(partial / STATE_FILE, json.dumps(asdict(progress)))
            sync_files(partial)  # as well as the metrics of the steps before it
            sync_file(self.path / METRICS_FILE)
            shutil.rmtree(final, ignore_errors=True)
            partial.rename(final)
            sync_file(self.checkpoints)
        self._settle(progress)

    def resume(self, learner: Learner) -> Progress:
        """Load the weights of the last checkpoint, if there is one.

        Returns:
            Progress of the run.

        Raises:
            InputFileError: The checkpoint is damaged or does not fit.
        """
        checkpoint = self.latest()
        if checkpoint is None:
            return Progress()
        file = checkpoint / STATE_FILE
        try:
            progress = Progress(**read_json(file))
        except (OSError, ValueError, TypeError) as error:
            raise InputFileError(f"{file} cannot be read ({error}); delete {checkpoint}.") from error
        learner.read(checkpoint)
        return progress

    def optimizer_state(self) -> dict[str, dict[str, torch.Tensor]]:
        """Read the optimizer state of the last checkpoint, by name of the parameter.

        Raises:
            InputFileError: It is damaged.
        """
        checkpoint = self.latest()
        assert checkpoint is not None  # it says how many steps are done
        state: dict[str, dict[str, torch.Tensor]] = {}
        for key, tensor in read_safetensors(checkpoint / OPTIMIZER_FILE).items():
            parameter, _, name = key.partition("|")
            state.setdefault(parameter, {})[name] = tensor
        return state

    def append(self, file: str, values: dict[str, Any]) -> None:
        """Add one line to `METRICS_FILE` or `TIMINGS_FILE`."""
        with naming(self.path / file), (self.path / file).open("a", encoding="utf-8") as lines:
            lines.write(json.dumps(values) + "\n")

    def rewind_to(self, progress: Progress) -> None:
        """Remove metrics of steps after the last checkpoint, which will be repeated.

        What a kill just after that checkpoint was written left undone is done.
        """
        self._settle(progress)
        file, reached = self.path / METRICS_FILE, (progress.stage, progress.step)
        kept = [each for each in read_lines(file) if (each["stage"], each["step"]) <= reached]
        if file.is_file():
            atomic_write_file(file, "".join(json.dumps(each) + "\n" for each in kept))

    def _settle(self, progress: Progress) -> None:
        """Name the best checkpoint, and delete those that are neither it, the last nor permanent."""
        if progress.best_checkpoint:
            atomic_write_file(self.checkpoints / BEST_FILE, progress.best_checkpoint)
        kept, every = {self.latest(), self.checkpoints / progress.best_checkpoint}, self._keep_every
        for other in filter(Path.is_dir, self.checkpoints.iterdir()):
            step = other.name.rpartition("-")[2]
            is_permanent = every is not None and step.isdigit() and int(step) % every == 0
            if not (is_permanent or other in kept):
                shutil.rmtree(other)

    def _differences(self, settings: dict[str, Any]) -> list[str]:
        file = self.path / CONFIG_FILE
        if not file.is_file():
            if self.path.is_dir() and not all(map(is_lock_file, self.path.iterdir())):
                raise ConfigError(f"{self.path} holds other files and no training run; give another --out.")
            return []
        try:
            old = read_yaml(file)
        except InputFileError as error:
            return [str(error).rstrip(".")]
        return differences(flatten(old), flatten(settings))


def read_lines(file: Path) -> list[dict[str, Any]]:
    """Read `METRICS_FILE`, `TIMINGS_FILE` or `SESSIONS_FILE`; empty without a file.

    An interruption may have cut the last line, also of an earlier session; such lines are left out.
    """
    found = []
    for line in file.read_text(encoding="utf-8").splitlines() if file.is_file() else ():
        with suppress(json.JSONDecodeError):
            found.append(json.loads(line))
    return found


def provenance(dataset: Dataset) -> dict[str, Any]:
    """Return versions, the git commit of the package if it is in a checkout, and digests of the data."""
    content = (dataset.path / MANIFEST_NAME).read_bytes()
    return {
        "versions": dict(versions_of("torch", "numpy", "pyarrow", "safetensors", "transformers")),
        "git": git_state(Path(openvima.__file__).parent),
        "data": {
            "content_hash": dataset.manifest["content_hash"],
            "manifest_sha256": hashlib.sha256(content).hexdigest(),
            "counts": dataset.manifest["counts"],
            "tasks": dict(sorted(Counter(dataset.index.column("task").to_pylist()).items())),
        },
    }


def held_out_demonstrations(dataset: Dataset) -> list[str]:
    """Return the task and level of demonstrations of evaluation levels or seeds, such as "twist L3".

    Each episode says its own level and domain, so merging or sampling folders hides nothing.
    """
    found = dataset.index.group_by(["task", "level", "domain"]).aggregate([])
    return sorted(
        f"{row['task']} {row['level']}" + (" eval" if row["domain"] == "eval" else "")
        for row in found.to_pylist()
        if row["level"] != "train" or row["domain"] == "eval"
    )


def git_state(folder: Path) -> dict[str, Any] | None:
    """Return the commit of the checkout that contains a folder, and whether it has changes.

    Returns:
        `commit` and `changed`; None without checkout or git.
    """

    def ask(*words: str) -> str:
        command, silent = ["git", "-C", str(folder), *words], subprocess.DEVNULL
        return subprocess.check_output(command, stderr=silent, encoding="utf-8", timeout=10).strip()

    try:
        ask("ls-files", "--error-unmatch", ".")  # fails for a package that is installed inside a checkout
        changes = ask("status", "--porcelain", "--untracked-files=no")
        return {"commit": ask("rev-parse", "HEAD"), "changed": bool(changes)}
    except (OSError, subprocess.SubprocessError, UnicodeDecodeError):
        return None


def read_costs(run: Path) -> dict[str, Any]:
    """Return steps, time and CPU time of a run.

    Work that was repeated after an interruption counts twice; what was lost after the last line of the log
    does not count.

    Args:
        run: The run folder.

    Returns:
        "steps" of each stage by name, "seconds" and "cpu_seconds" of all sessions together.
    """
    steps: dict[str, int] = {}
    for record in read_lines(run / METRICS_FILE):
        steps[record["name"]] = max(record["step"], steps.get(record["name"], 0))
    seconds, cpu_seconds, last = 0.0, 0.0, (0.0, 0.0)
    for record in read_lines(run / TIMINGS_FILE):
        now = (record["seconds_since_start"], record["cpu_seconds_since_start"])
        if now[0] < last[0]:  # a session begins at 0
            last = (0.0, 0.0)
        seconds += now[0] - last[0]
        cpu_seconds += now[1] - last[1]
        last = now
    return {"steps": steps, "seconds": round(seconds, 1), "cpu_seconds": round(cpu_seconds, 1)}
