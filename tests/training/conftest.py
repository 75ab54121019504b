"""A small data set, and settings for training that takes seconds."""

from pathlib import Path

import pytest

from openvima.data import GenerateConfig, generate
from openvima.data.records import Demonstration, rollout_oracle
from openvima.env import TabletopEnv
from openvima.policies import presets
from small_networks import narrow

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
    monkeypatch.setitem(presets.PRESETS, "tiny", lambda: narrow("nano", 32))
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
