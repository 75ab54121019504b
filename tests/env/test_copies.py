"""Environments in use can be copied and pickled, and go on as the original does."""

import copy
import pickle
import zlib
from collections.abc import Callable
from typing import Any  # observations and environments of all kinds

import gymnasium
import numpy as np
import pytest

import openvima
from openvima.env import make_vec
from openvima.tasks import list_tasks
from task_cases import full_repr, random_action

COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


@pytest.fixture(params=COPIES)
def copied(request: pytest.FixtureRequest) -> Callable[[Any], Any]:
    return COPIES[request.param]


def images(observation: dict[str, Any]) -> list[np.ndarray]:
    return [*observation["rgb"].values(), *observation["segm"].values()]


def steps(env: gymnasium.Env, rng: np.random.Generator, is_over: bool) -> list[int]:
    """Checksums of all that is seen of further random steps until the end, and of the next episode."""
    seen = [
        full_repr(env.unwrapped.scene).encode(),
        env.unwrapped.joint_path.tobytes(),
        env.render().tobytes(),
    ]
    while not is_over:
        observation, *rest = env.step(random_action(rng, env.unwrapped.scene))
        seen += [image.tobytes() for image in images(observation)]
        seen += [full_repr(rest).encode(), full_repr(env.unwrapped.scene).encode()]
        is_over = rest[1] or rest[2]
    observation, info = env.reset()
    seen += [full_repr(info).encode(), *(image.tobytes() for image in images(observation))]
    return [zlib.crc32(entry) for entry in seen]


@pytest.mark.parametrize("task", list_tasks())
def test_a_copy_of_a_used_environment_goes_on_as_it_does(task: str, copied: Callable) -> None:
    env = openvima.make(task, render_mode="rgb_array")
    env.reset(seed=3)
    action = random_action(np.random.default_rng(0), env.unwrapped.scene)
    _, _, terminated, truncated, _ = env.step(action)
    env.render()
    _ = env.unwrapped.prompt
    results = [steps(each, np.random.default_rng(1), terminated or truncated) for each in (copied(env), env)]
    assert results[0] == results[1]


def test_a_copy_and_its_original_do_not_touch_each_other(copied: Callable) -> None:
    env = openvima.make("rotate")
    env.reset(seed=3)
    before = full_repr(env.unwrapped.scene)
    other = copied(env)
    decision = other.unwrapped.oracle_decision()
    assert full_repr(decision) == full_repr(env.unwrapped.oracle_decision())
    assert other.step(decision.action.to_arrays())[1] == 1.0
    assert full_repr(env.unwrapped.scene) == before
    assert env.step(decision.action.to_arrays())[1] == 1.0


def test_vector_environments_in_one_process_are_copied(copied: Callable) -> None:
    envs = make_vec("rotate", 2, seeds=range(6))
    envs.reset()
    other = copied(envs)
    for each in (envs, other):
        each.action_space.seed(0)
    results = [each.step(each.action_space.sample()) for each in (envs, other)]
    assert full_repr(results[0][1:]) == full_repr(results[1][1:])
    pairs = zip(images(results[0][0]), images(results[1][0]), strict=True)
    assert all(np.array_equal(one, two) for one, two in pairs)
    assert not any(
        np.shares_memory(a, b) for a, b in zip(images(results[0][0]), images(results[1][0]), strict=True)
    )
