"""Distributed training and loader workers give the results of one process."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from openvima.errors import ConfigError
from openvima.policies import load_policy, presets
from openvima.training import TrainingConfig, train
from openvima.training.parallel import (
    join_processes,
    start_peers,
)
from plugged_extractors import HOOK
from small_networks import metrics_of, training_script

pytestmark = pytest.mark.slow


@pytest.fixture
def bins(settings, monkeypatch) -> dict:
    """A network whose loss is a mean over steps, without dropout, which each process draws for itself."""

    def tiny():
        sizes = presets.preset("vima-nano")
        decoder = replace(sizes.decoder, width=32, num_layers=1, dropout=0.0)
        images = replace(sizes.images, width=32)
        text = replace(sizes.prompt.text, num_layers=1)
        return replace(sizes, decoder=decoder, images=images, prompt=replace(sizes.prompt, text=text))

    monkeypatch.setitem(presets.PRESETS, "tiny-bins", tiny)
    changes = {
        "preset": "tiny-bins",
        "pretraining.steps": 0,
        "schedule.steps": 6,
        "loader.batch_size": 8,
        "schedule.checkpoint_every": 1,
    }
    return {**settings, **changes, "augmentation.false_positive_prob": 0.3}


def run_in_processes(count: int, settings: dict) -> Path:
    """Train in so many processes, as `torchrun` starts them; with "kill_at" the first one dies then."""
    arguments = training_script(settings)
    port = str(29_000 + os.getpid() % 5000)
    processes = [
        subprocess.Popen(
            [sys.executable, *arguments],
            env={
                **os.environ,
                "RANK": str(rank),
                "LOCAL_RANK": str(rank),
                "WORLD_SIZE": str(count),
                "MASTER_ADDR": "127.0.0.1",
                "MASTER_PORT": port,
                "OMP_NUM_THREADS": "1",
            },
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(count)
    ]
    try:
        errors = [process.communicate(timeout=300)[1] for process in processes]
    finally:
        for process in processes:
            process.kill()
    codes = [process.returncode for process in processes]
    assert all(codes) if "kill_at" in settings else not any(codes), errors
    return Path(settings["out"])


def assert_alike(ours: Path, theirs: Path) -> None:
    """The loss curves of training and validation are equal but for the last bits.

    Weights differ more: Adam divides by the size of a gradient, and where that is next to nothing, the last
    bits of it decide the step.
    """
    for a, b in zip(metrics_of(ours), metrics_of(theirs), strict=True):
        assert a.keys() == b.keys()
        for name in ("step", "name", "accuracy", "validation_accuracy"):
            assert a.get(name) == (pytest.approx(b[name]) if name in b else None)
        for name in ("loss", "validation_loss"):
            assert a.get(name) == (pytest.approx(b[name], rel=1e-5) if name in b else None)
        assert a.get("gradient_norm", 0) == pytest.approx(b.get("gradient_norm", 0), rel=1e-3)


def test_two_processes_train_as_one(bins, tmp_path) -> None:
    bins |= {"loader.boxes": HOOK}
    one = train(TrainingConfig.of({**bins, "out": tmp_path / "one"}))
    parts = {"optimizer.grad_accum_steps": 8}  # more than demonstrations of a process
    two = run_in_processes(2, {**bins, **parts, "out": tmp_path / "two"})
    assert_alike(one, two)
    load_policy(str(two))


def test_a_run_of_two_processes_resumes_with_one(bins, tmp_path) -> None:
    whole = train(TrainingConfig.of({**bins, "out": tmp_path / "whole"}))
    torn = {**bins, "out": tmp_path / "torn"}
    run_in_processes(2, {**torn, "kill_at": 4})
    assert sorted(path.name for path in (tmp_path / "torn/checkpoints").glob("2-*"))[-1].endswith("000003")
    assert_alike(whole, train(TrainingConfig.of(torn)))


def test_processes_share_contrastive_pretraining(settings, tmp_path) -> None:
    """And then clone text prompts, which leave parameters without gradients."""
    settings |= {"pretraining.hard_negative_prob": 0.5, "schedule.steps": 3, "loader.batch_size": 2}
    settings["augmentation.text_description_prob"] = 1.0
    one = train(TrainingConfig.of({**settings, "out": tmp_path / "one"}))
    shared = {**settings, "out": tmp_path / "two"}
    with start_peers(1, training_script(shared)):
        two = train(TrainingConfig.of(shared))
    assert "WORLD_SIZE" not in os.environ
    pairs = zip(metrics_of(one), metrics_of(two), strict=True)
    pairs = [(a, b) for a, b in pairs if a["name"] == "1-pretraining"]
    assert len(pairs) == 4  # two checkpoints
    for a, b in pairs:
        assert a.pop("name") == b.pop("name")
        assert a == pytest.approx(b, rel=1e-3)


def test_loader_workers_and_gradient_accumulation_change_only_the_last_bits(bins, tmp_path) -> None:
    plain = train(TrainingConfig.of({**bins, "out": tmp_path / "plain"}))
    ahead = train(TrainingConfig.of({**bins, "out": tmp_path / "ahead", "loader.num_workers": 2}))
    assert (plain / "metrics.jsonl").read_bytes() == (ahead / "metrics.jsonl").read_bytes()
    parts = train(TrainingConfig.of({**bins, "out": tmp_path / "parts", "optimizer.grad_accum_steps": 4}))
    assert_alike(plain, parts)


def test_a_missing_device_is_named() -> None:
    for device in ("gpu0", "meta", "cuda:99", *(() if torch.cuda.is_available() else ("cuda",))):
        message = f"device is '{device}'; it must be auto, cpu"
        with pytest.raises(ConfigError, match=message), join_processes(device):
            pass
