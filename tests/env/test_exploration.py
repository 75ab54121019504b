"""A little of `benchmarks/explore.py`: low-level control takes any commands, and the benchmark sees harm."""

import numpy as np
import pytest

import openvima
from explore import FIRST_SEED, explore
from openvima.errors import ReachError
from openvima.sim.tool_world import ToolWorld


def make(task: str) -> openvima.TabletopEnv:
    return openvima.make(task, control="end_effector", modalities=("joints",))


@pytest.mark.parametrize(
    ("task", "episodes"),
    [
        ("visual_manipulation", 8),
        ("sweep_without_exceeding", 8),
        *(
            pytest.param(task, 120, marks=pytest.mark.slow)
            for task in ("rotate", "pick_in_order_then_restore", "sweep_without_touching")
        ),
    ],
)
def test_smooth_exploration_raises_nothing_and_stays_in_the_space(task: str, episodes: int) -> None:
    env = make(task)
    for seed in range(FIRST_SEED, FIRST_SEED + episodes):
        assert explore(env, seed, steps=100) == [], seed


@pytest.mark.parametrize("task", ["rotate", "sweep_without_touching"])
def test_one_command_repeated_into_a_corner_stops_there(task: str) -> None:
    for first in ([0, 0, 0, 0, 0], [0, 0, 0.05, 0, 0], [0, 0, -0.05, 0, 0]):
        for command in ([0.05, 0.05, 0, 0, 0], [0.05, -0.05, 0, 0.2, 1], [0.05, 0.05, -0.05, 0, 1]):
            env = make(task)
            env.reset(seed=0)
            for each in (*[first] * 10, *[command] * 30):
                observation, _, terminated, truncated, _ = env.step(np.float32(each))
                assert observation in env.observation_space
                if terminated or truncated:
                    break


def test_errors_and_a_tool_that_has_left_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **options: object) -> None:
        raise ReachError("too far")

    env = make("rotate")
    monkeypatch.setattr(
        "openvima.env.running_episode.ToolRun.observed_tool", lambda _: {"tool": np.full(5, 0.9)}
    )
    assert "the tool is at (0.9000" in explore(env, 0, steps=1)[-1]
    monkeypatch.setattr(ToolWorld, "command", fail)
    assert "ReachError in fail: too far" in explore(env, 0, steps=1)[-1]
