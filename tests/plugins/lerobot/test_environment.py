"""The environment of the plugin, which needs no LeRobot itself."""

import importlib.util
import logging
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from openvima.data.lerobot_frames import FrameLayout

FILE = Path(__file__).parents[3] / "plugins/lerobot/lerobot_env_openvima/env.py"
FIXED = {"prompts": "multimodal", "control": "primitives", "layout": FrameLayout(1, True), "fps": 1}
LOW_LEVEL = {
    "prompts": "text",
    "control": "end_effector",
    "layout": FrameLayout(0, True, "end_effector"),
    "fps": 10,
}


@pytest.fixture(scope="module")
def make() -> Any:
    """What makes an environment; the package around its file imports LeRobot."""
    spec = importlib.util.spec_from_file_location("lerobot_env_openvima_env", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return partial(module.OpenVimaEnv, "rotate", level="L1", **FIXED)


def oracle_row(env: Any) -> np.ndarray:
    return np.concatenate(list(env._env.oracle_decision().action.to_arrays().values()))


def test_the_oracle_solves_episodes_in_the_form_that_lerobot_reads(make: Any) -> None:
    mode = gymnasium.vector.AutoresetMode.SAME_STEP
    envs = gymnasium.vector.SyncVectorEnv([make, make], autoreset_mode=mode)
    seen, _ = envs.reset(seed=[1000, 1001], options={"lerobot_new_rollout": True})
    assert seen["pixels"]["prompt_0_top"].shape == (2, 128, 256, 3)
    assert seen["agent_pos"].dtype == np.float32
    assert [env._env.episode.seed for env in envs.envs] == [1000, 1001]
    assert {env._env.episode.domain for env in envs.envs} == {"eval"}
    assert all("degrees" in text for text in envs.call("task_description"))
    assert envs.call("_max_episode_steps") == (5, 5)
    assert envs.call("render")[0].shape == (256, 256, 3)
    _, rewards, terminated, _, info = envs.step(np.stack([oracle_row(env) for env in envs.envs]))
    assert terminated.all() and rewards.tolist() == [1, 1]
    assert info["final_info"]["is_success"].tolist() == [True, True]


def test_the_oracle_solves_an_episode_by_commands_with_a_prompt_of_text(make: Any) -> None:
    env = make(**LOW_LEVEL)
    seen, _ = env.reset(seed=1000)
    assert "{" not in env.task_description and env._max_episode_steps == 500
    assert set(seen["pixels"]) == {"front", "top"} and seen["agent_pos"].shape == (12,)
    terminated = False
    while not terminated:
        command = env._env.oracle_command().to_array()
        seen, _, terminated, truncated, info = env.step(command)
        assert not truncated
    np.testing.assert_array_equal(seen["agent_pos"][6:11], env._env.observe()["tool"])
    assert info["is_success"]


@pytest.mark.parametrize(
    ("changes", "row", "message"),
    [
        (LOW_LEVEL, np.zeros(12, np.float32), "the episode ends"),
        (LOW_LEVEL, np.zeros(5, int), "the episode ends"),
        (LOW_LEVEL, np.full(5, np.inf, np.float32), "the episode ends"),
        ({}, np.full(12, np.nan, np.float32), "must be finite"),
    ],
)
def test_a_malformed_action_ends_the_episode_as_a_failure(
    make: Any, changes: dict, row: np.ndarray, message: str, caplog: pytest.LogCaptureFixture
) -> None:
    env = make(**changes)
    before, _ = env.reset(seed=1000)
    with caplog.at_level(logging.WARNING):
        seen, *rest = env.step(row)
    assert seen is before and rest == [0.0, True, False, {"is_success": False}]
    assert message in caplog.text
