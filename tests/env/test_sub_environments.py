"""Episodes prepared ahead."""

from typing import Any  # infos are nested dictionaries

import numpy as np
import pytest

import openvima
from openvima.env import TabletopEnv, stack_actions
from openvima.errors import ConfigError, SamplingError
from openvima.tasks import sample_episode
from task_cases import frozen, random_action

# Scenes as prompts, several frames, a spatula, clutter, instructions in a row.
SLOW_TASKS = [
    pytest.param(task, marks=pytest.mark.slow)
    for task in ("rearrange", "follow_order", "sweep_without_touching", "twist", "put_then_restore")
]


def start_of(env: TabletopEnv, **arguments: Any) -> Any:
    """All that is seen of an episode's start and of its first step."""
    start = env.reset(**arguments)
    drawn = env.np_random.bit_generator.state
    action = env.oracle_decision().action if env.control == "primitives" else env.oracle_command()
    return frozen([start, env.prompt, drawn, env.episode, env.step(action)])


@pytest.mark.parametrize("task", ["rotate", *SLOW_TASKS])
def test_a_prepared_episode_has_the_same_bytes(task: str, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = start_of(TabletopEnv(task), seed=5)
    env = TabletopEnv(task)
    env.reset(seed=3)
    env.prepare(5)
    monkeypatch.delattr("openvima.env.tabletop.sample_episode")  # the reset needs no other
    assert start_of(env, seed=5) == expected


def test_the_seed_that_a_reset_draws_is_foreseen(monkeypatch: pytest.MonkeyPatch) -> None:
    env, other = TabletopEnv("rotate"), TabletopEnv("rotate")
    other.reset(seed=3)
    expected = [start_of(other) for _ in range(2)]
    env.reset(seed=3)
    env.prepare()
    with monkeypatch.context() as patch:
        patch.delattr("openvima.env.tabletop.sample_episode")
        assert start_of(env) == expected[0]
    assert start_of(env) == expected[1]


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"level": "L1"},
        {"domain": "eval"},
        {"prompts": "text"},
        {"compat": True},
        {"control": "end_effector"},
        {"task_options": {"num_distractors": 2}},
    ],
)
def test_settings_that_change_after_the_preparation_count(change: dict[str, Any]) -> None:
    env, expected = TabletopEnv("rotate"), TabletopEnv("rotate")
    env.prepare(5)
    for each in (env, expected):
        for name, value in change.items():
            setattr(each, name, value)
    assert start_of(env, seed=5) == start_of(expected, seed=5)


def test_a_reset_to_another_episode_discards_the_prepared_one() -> None:
    env, expected = TabletopEnv("rotate"), TabletopEnv("rotate")
    episode = sample_episode("twist", seed=8)
    for arguments in ({"seed": 6}, {"options": {"episode": episode}}, {"seed": 5}):
        env.prepare(5)
        assert start_of(env, **arguments) == start_of(expected, **arguments)


def test_an_episode_is_prepared_while_another_is_running() -> None:
    env, expected = TabletopEnv("rotate"), TabletopEnv("rotate")
    for each in (env, expected):
        each.reset(seed=3)
    env.prepare(5)
    action = env.oracle_decision().action
    assert frozen(env.step(action)) == frozen(expected.step(action))


def test_what_cannot_be_prepared_raises_and_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise SamplingError("no place for the target")

    env = TabletopEnv("rotate")
    env.reset(seed=3)
    with pytest.raises(ConfigError, match="seed is -1"):
        env.prepare(-1)
    with monkeypatch.context() as patch:
        patch.setattr("openvima.env.tabletop.sample_episode", fail)
        with pytest.raises(SamplingError):
            env.prepare(5)
    assert env.episode.seed == 3
    assert start_of(env, seed=5) == start_of(TabletopEnv("rotate"), seed=5)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [None, range(9)])
def test_workers_that_prepare_play_the_episodes_of_one_process(seeds: range | None) -> None:
    def play(num_workers: int) -> list[Any]:
        tasks = ["rotate", "visual_manipulation", "sweep_without_exceeding"]
        envs = openvima.make_vec(tasks, num_workers=num_workers, seeds=seeds)
        rng, seen = np.random.default_rng(0), []
        for seed in (1, [7, 8, None], None):
            seen.append(frozen(envs.reset(seed=seed)))
            for step in range(8):
                if num_workers and step % 2:
                    envs.call("prepare")  # besides what workers do on their own
                if step == 4:
                    envs.set_attr("prompts", "text" if seed is None else "mixed")
                actions = [random_action(rng, scene) for scene in envs.get_attr("scene")]
                seen.append(frozen(envs.step(stack_actions(actions))))
                seen.append(frozen(envs.get_attr("prompt")))
        envs.close()
        return seen

    assert play(2) == play(0)
