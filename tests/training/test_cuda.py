"""Training on a GPU gives what training on a CPU gives."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from openvima.evaluation import EvaluationConfig, evaluate
from openvima.policies import presets
from openvima.training import TrainingConfig, train
from small_networks import metrics_of, train_until

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device"),
]
# Convolutions in float32 multiply in TF32, and differences grow from step to step.
TOLERANCE = {"float32": 0.01, "bfloat16": 0.05}
NAMES = ("small", "vima-2m", "gato-2m", "flamingo-2m", "gpt-2m", "midas-2m")


def losses(run: Path) -> list[dict]:
    names = ("stage", "step", "loss", "validation_loss")
    return [{name: line[name] for name in names if name in line} for line in metrics_of(run)]


@pytest.fixture
def without_dropout(settings, monkeypatch) -> dict:
    """Dropout draws other numbers on a GPU."""
    for name in NAMES:
        sizes = presets.preset(name)
        sizes = replace(sizes, decoder=replace(sizes.decoder, num_layers=1, dropout=0.0))
        monkeypatch.setitem(presets.PRESETS, f"{name}-without-dropout", lambda sizes=sizes: sizes)
    return settings | {"augmentation.text_description_prob": 0.3}


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("name", NAMES)
def test_losses_are_those_of_a_cpu(name, precision, without_dropout, tmp_path) -> None:
    settings = {**without_dropout, "preset": f"{name}-without-dropout", "runtime.precision": precision}
    settings["model.text_encoder"] = "small" if name != "small" else None
    settings["pretraining.steps"] = 4 if name == "small" else 0
    if name == "small":
        settings |= {"pretraining.attribute_loss_weight": 0.5, "pretraining.hard_negative_prob": 0.4}
    runs = [
        train(TrainingConfig.of({**settings, "runtime.device": device, "out": tmp_path / device}))
        for device in ("cpu", "cuda")
    ]
    on_cpu, on_gpu = map(losses, runs)
    assert len(on_gpu) == len(on_cpu) > 4
    for ours, theirs in zip(on_gpu, on_cpu, strict=True):
        assert ours == pytest.approx(theirs, rel=TOLERANCE[precision])


def test_an_interrupted_run_resumes_and_its_policy_acts_on_both_devices(settings, tmp_path) -> None:
    changes = {"runtime.device": "cuda", "runtime.precision": "bfloat16"}
    config = TrainingConfig.of({**settings, **changes, "schedule.checkpoint_every": 1})
    train_until(config, 7)
    run = train(config)
    assert losses(run)[-1]["step"] == 6
    for device in ("cpu", "cuda"):
        scores = EvaluationConfig(
            policies=(str(run),), tasks=("rotate",), levels=("L1",), episodes=2, out=tmp_path / device
        )
        assert evaluate(replace(scores, device=device)).exists()
