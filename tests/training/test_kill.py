"""Runs that are interrupted: by Ctrl-C, or killed."""

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from openvima.errors import Terminated
from openvima.policies import load_policy
from openvima.training import TrainingConfig, loop, train
from small_networks import training_script

pytestmark = pytest.mark.slow


@pytest.fixture
def config(settings) -> TrainingConfig:
    return TrainingConfig.of({**settings, "schedule.checkpoint_every": 1})


@pytest.fixture
def whole(settings, tmp_path) -> Path:
    """A run that was never interrupted."""
    return train(TrainingConfig.of({**settings, "schedule.checkpoint_every": 1, "out": tmp_path / "whole"}))


def assert_same(run: Path, whole: Path) -> None:
    """Checkpoints and metrics are equal, bit for bit."""
    checkpoints = {path.name for path in (whole / "checkpoints").iterdir()}
    assert {path.name for path in (run / "checkpoints").iterdir()} == checkpoints
    assert_same_weights(run, whole)
    for name in ("metrics.jsonl", "config.yaml"):
        assert (run / name).read_bytes() == (whole / name).read_bytes()


def assert_same_weights(run: Path, whole: Path) -> None:
    for file in whole.rglob("*.safetensors"):
        ours, theirs = load_file(run / file.relative_to(whole)), load_file(file)
        assert ours.keys() == theirs.keys()
        assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def interrupted(config: TrainingConfig, at: str) -> None:
    """Train, and press Ctrl-C at the second report whose note begins so."""
    seen = 0

    def report(done: int, total: int, note: str) -> None:
        nonlocal seen
        seen += note.startswith(at)
        if seen == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, report)


def test_a_run_stopped_by_the_keyboard_in_each_stage_resumes_exactly(config, whole) -> None:
    for stage in ("1-pretraining", "2-cloning"):
        interrupted(config, stage)
    assert_same(train(config), whole)


def test_a_killed_process_leaves_whole_files_and_resumes(config, settings, whole) -> None:
    arguments = training_script({**settings, "schedule.checkpoint_every": 1})
    for stage in ("1-pretraining", "2-cloning"):
        process = subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        seen = 0
        for line in process.stdout:  # a report comes right before a checkpoint is written
            seen += line.startswith(stage)
            if seen == 3:
                process.kill()
                break
        process.stdout.close()
        assert process.wait() == -signal.SIGKILL
        for checkpoint in (config.out / "checkpoints").iterdir():
            if checkpoint.is_dir() and checkpoint.suffix != ".partial":
                load_policy(str(checkpoint))
                load_file(checkpoint / "optimizer.safetensors")
                json.loads((checkpoint / "state.json").read_text())
    assert_same(train(config), whole)


@pytest.fixture
def default_sigterm() -> Iterator[None]:
    """The handler that processes begin with: Ray, used by another test, may have set its own."""
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGTERM, before or signal.SIG_DFL)


@pytest.mark.usefixtures("default_sigterm")
@pytest.mark.parametrize("stage", ["1-pretraining", "2-cloning"])
def test_sigterm_writes_a_checkpoint_and_the_run_resumes(settings, tmp_path, stage: str, monkeypatch) -> None:
    """The weights are those of a run that was never ended, whatever step the signal comes at."""
    monkeypatch.setattr(loop, "LOG_EVERY", 1)
    settings = {**settings, "schedule.checkpoint_every": 100}
    whole = train(TrainingConfig.of({**settings, "out": tmp_path / "never ended"}))
    config = TrainingConfig.of(settings)
    seen = 0

    def report(done: int, total: int, note: str) -> None:
        nonlocal seen
        seen += note.startswith(stage)
        if seen == 2:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Terminated):
        train(config, report)
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert (config.out / "checkpoints" / f"{stage}-000003" / "state.json").exists()
    train(config)
    assert_same_weights(config.out, whole)
