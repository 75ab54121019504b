"""A small data set, and settings for training that takes seconds."""

from dataclasses import replace
from pathlib import Path

import pytest

from openvima.data import GenerateConfig, generate
from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies import presets

TASKS = ("rotate", "sweep_without_exceeding", "visual_manipulation")


@pytest.fixture(scope="session")
def data(tmp_path_factory) -> Path:
    """Eight demonstrations of each of three tasks."""
    folder = tmp_path_factory.mktemp("data")
    return generate(GenerateConfig(out=folder / "demos", tasks=TASKS, episodes=8))


@pytest.fixture(scope="session")
def demonstrations_of_several_steps() -> list[Demonstration]:
    """Six, of one to three steps, some with objects that get hidden on the way."""
    several = TabletopEnv("manipulate_old_neighbor", level="train", domain="user")
    single = TabletopEnv("visual_manipulation", level="train", domain="user")
    return [rollout_oracle(several, seed) for seed in range(4)] + [
        rollout_oracle(single, seed) for seed in range(2)
    ]


@pytest.fixture
def settings(data: Path, tmp_path: Path, monkeypatch) -> dict:
    """Arguments of a run of a narrow network over a few steps."""
    from openvima.policies.nn.image_encoders import ConvConfig

    def tiny():
        sizes = presets.preset("nano")
        return replace(
            sizes,
            images=replace(sizes.images, crop=ConvConfig(width=4, output_width=16), width=32),
            prompt=replace(sizes.prompt, text=replace(sizes.prompt.text, num_layers=1)),
            decoder=replace(sizes.decoder, width=32, num_layers=1, num_self_heads=2, num_cross_heads=2),
        )

    monkeypatch.setitem(presets.PRESETS, "tiny", tiny)
    return {
        "data": data,
        "out": tmp_path / "run",
        "preset": "tiny",
        "schedule.steps": 6,
        "loader.batch_size": 6,
        "pretraining.steps": 4,
        "pretraining.num_scenes": 16,
        "pretraining.batch_size": 16,
        "loader.validation_fraction": 0.2,
        "schedule.checkpoint_every": 2,
        "runtime.threads": 1,
    }
