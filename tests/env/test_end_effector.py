"""Control "end_effector" of the environment, and its evaluation."""

import copy
import itertools

import gymnasium
import numpy as np
import pytest

import openvima
from openvima.env import EnvConfig
from openvima.errors import ActionError, ConfigError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.comparison import merge
from openvima.evaluation.verification import verify_results
from openvima.scene.action import COMMAND_HIGH, STEPS_PER_PRIMITIVE, ToolCommand

STAY = np.zeros(5, np.float32)


def make(task: str, **options) -> openvima.TabletopEnv:
    options = {"level": "L1", "modalities": ("joints",), **options}
    return openvima.make(task, control="end_effector", **options)


@pytest.mark.parametrize("task", ["rotate", "sweep_without_exceeding", "pick_in_order_then_restore"])
def test_the_oracle_solves_an_episode_and_success_comes_when_the_tool_has_let_go(task) -> None:
    env = make(task)
    observation, _ = env.reset(seed=0)
    terminated = truncated = False
    while not (terminated or truncated):
        command = env.oracle_command()
        observation, reward, terminated, truncated, info = env.step(command)
    assert info["success"]
    assert reward == 1.0
    assert not command.tool
    assert observation["tool"][4] == 0.0
    assert info["num_steps"] < STEPS_PER_PRIMITIVE * env.episode.oracle_max_steps


@pytest.mark.parametrize("task", ["rotate", "sweep_without_exceeding"])
def test_the_oracle_solves_an_episode_from_states_that_it_did_not_choose(task) -> None:
    env, rng = make(task), np.random.default_rng(0)
    env.reset(seed=0)
    noise = np.array([0.02, 0.02, 0.02, 0.1, 0.0])
    is_over = False
    while not is_over:
        command = env.oracle_command()
        assert env.oracle_command() == command
        given = command.to_array() + noise * rng.uniform(-1, 1, 5)
        given[4] = rng.random() < 0.5 if rng.random() < 0.1 else given[4]
        *_, terminated, truncated, _ = env.step(given.astype(np.float32))
        is_over = terminated or truncated
    assert env.outcome.success


def test_images_follow_the_body_on_the_cup_while_it_moves() -> None:
    env = make("rotate", modalities=("segm",), realtime=True)
    env.reset(seed=0)
    seen = []
    while not env.outcome.is_over:
        observation, *_, info = env.step(env.oracle_command())
        assert len(env.frames) == 3
        if info["grasped"]:
            seen.append(observation["segm"]["front"] == info["grasped"])
    changes = sum((one != other).any() for one, other in itertools.pairwise(seen))
    assert changes > 5


def test_videos_of_steps_last_as_long_as_the_steps() -> None:
    options = {"control": "end_effector", "render_mode": "rgb_array", "modalities": ("joints",)}
    built = [
        openvima.make("rotate", **options),
        gymnasium.make("openvima/rotate-v1", **options),
        openvima.make_vec("rotate", 2, num_workers=0, **options),
        openvima.make_vec("rotate", 2, num_workers=1, **options),
        gymnasium.make_vec("openvima/rotate-v1", num_envs=2, **options),
    ]
    assert [env.metadata["render_fps"] for env in built] == [10] * len(built)  # RecordVideo reads it
    for env in built:
        env.close()
    other = openvima.make_vec("rotate", 2, render_mode="rgb_array")
    assert other.metadata["render_fps"] == openvima.TabletopEnv.metadata["render_fps"] == 1


def test_time_is_limited() -> None:
    env = make("rotate")
    env.reset(seed=0)
    limit = env.episode.max_steps * STEPS_PER_PRIMITIVE
    for step in range(limit):
        *_, terminated, truncated, info = env.step(STAY)
        assert (terminated, truncated) == (False, step == limit - 1)
    assert info["num_steps"] == limit


def test_an_action_of_the_other_control_is_refused() -> None:
    env, other = make("rotate"), openvima.make("rotate")
    env.reset(seed=0), other.reset(seed=0)
    with pytest.raises(ActionError, match="5 floating-point numbers: dx, dy, dz, dyaw, tool"):
        env.step({"pose0_position": STAY[:2]})
    with pytest.raises(ActionError, match="a mapping with keys pose0_position"):
        other.step(STAY)
    with pytest.raises(ConfigError, match="control is 'primitives'; commands need control 'end_effector'"):
        other.oracle_command()
    with pytest.raises(ConfigError, match=r"no control 'end_efector'\. Did you mean 'end_effector'"):
        openvima.make("rotate", control="end_efector")
    assert env.outcome == other.outcome


@pytest.mark.parametrize(
    ("command", "problem"),
    [
        (np.zeros(4, np.float32), r"shape \(4,\)"),
        (np.zeros(5, np.int64), "dtype int64"),
        ([0, 0, np.nan, 0, 0.0], "all values must be finite"),
        (None, "a NoneType"),
    ],
)
def test_malformed_commands_are_loud(command, problem) -> None:
    with pytest.raises(ActionError, match=problem):
        ToolCommand.from_array(command)


def test_a_command_too_fast_keeps_its_direction() -> None:
    command = ToolCommand.from_array(np.array([0.4, -0.2, 0.0, 0.1, 0.6], np.float32))
    assert (command.dx, command.dy, command.dyaw) == pytest.approx((0.05, -0.025, 0.0125))
    assert command.tool
    fastest = np.array(COMMAND_HIGH, np.float32)
    assert (ToolCommand.from_array(fastest).to_array() == fastest).all()


def test_a_copy_of_the_environment_goes_on_equally() -> None:
    env = make("rotate")
    env.reset(seed=0)
    for _ in range(14):
        env.step(env.oracle_command())
    pair = (env, copy.deepcopy(env))
    tools = [[each.step(each.oracle_command())[0]["tool"].tobytes() for _ in range(5)] for each in pair]
    assert tools[0] == tools[1]
    assert pair[0].scene == pair[1].scene


def test_results_record_the_control_are_verified_and_joined_with_no_other(tmp_path) -> None:
    found = {}
    for control in ("primitives", "end_effector"):
        out, env_config = tmp_path / control, EnvConfig(control=control)
        config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), 1, out=out, env_config=env_config)
        found[control] = Results.read(evaluate(config))
        assert found[control].rows[0].successes == found[control].rows[0].successes_oracle_horizon == 1
        assert verify_results(out).problems == ()
    assert found["end_effector"].config["control"] == "end_effector"
    assert "control" not in found["primitives"].config
    assert found["end_effector"].rows[0].mean_steps > 10
    with pytest.raises(
        ConfigError, match=r"control is primitives in .*, end_effector in .*, so steps differ"
    ):
        merge(found)
