"""Composed scenes, and copies of environments."""

import copy
import pickle
import zlib
from collections.abc import Callable
from typing import Any  # observations and environments of all kinds

import gymnasium
import numpy as np
import pytest

import openvima
from openvima import compose
from openvima.catalog import load_assets
from openvima.data.user_demonstrations import check_recordable
from openvima.env import make_vec
from openvima.env.composition import Composition, parse_goals
from openvima.errors import DatasetError, SceneError, UnknownNameError
from openvima.tasks import sample_episode
from task_cases import REPRESENTATIVE_TASKS, full_repr, random_action

ASSETS = load_assets("procedural")
OBJECTS = {"heart": ("heart", "red", (0.45, -0.25), 40.0), "bowl": ("bowl", "green", (0.55, 0.25))}
EPISODE = compose(OBJECTS, "Put the {heart} into the {bowl}.", goals=[("in", "heart", "bowl")])


def test_a_composition_is_the_episode_that_it_came_from() -> None:
    scene = Composition.of(EPISODE)
    assert scene.episode(ASSETS) == EPISODE
    assert scene.goals_text == "[in, heart, bowl]" and parse_goals(scene.goals_text) == scene.goals


def test_objects_are_added_where_there_is_room_until_there_is_none() -> None:
    scene = Composition.of(EPISODE)
    for _ in range(3):
        scene = scene.added("pan", "blue", ASSETS)
    assert [each.name for each in scene.objects] == ["heart", "bowl", "a", "b", "c"]
    assert len(scene.episode(ASSETS).problem.scene.placements) == 5
    with pytest.raises(SceneError, match="no room for a blue pan"):
        for _ in range(20):
            scene = scene.added("pan", "blue", ASSETS)
    with pytest.raises(UnknownNameError):
        scene.added("pam", "blue", ASSETS)


def test_changes_leave_the_composition_before_as_it_was() -> None:
    scene = Composition.of(EPISODE)
    moved = scene.moved("heart", (0.40004, 0.0), 12.34)
    assert moved["heart"].position == (0.4, 0.0) and moved["heart"].yaw_deg == 12.3
    assert scene["heart"].position == (0.45, -0.25)
    assert moved.changed("heart", texture="blue")["heart"].texture == "blue"
    with pytest.raises(SceneError, match=r"overlaps object 'heart'|overlaps object 'bowl'"):
        scene.moved("heart", (0.55, 0.25), 0).episode(ASSETS)
    with pytest.raises(SceneError, match="'heart'"):
        scene.removed("heart").episode(ASSETS)  # the prompt shows it
    with pytest.raises(SceneError, match="no object 'star'; the scene has heart, bowl"):
        scene.removed("star")


def test_the_arrangement_becomes_a_prompt_image() -> None:
    scene = Composition.of(EPISODE)
    asked = Composition(scene.objects, "Rearrange to {goal}.", {"goal": scene.scene_image()})
    (image,) = dict(asked.episode(ASSETS).problem.prompt.images).values()
    assert [p.object for p in image.scene.placements] == ["heart", "bowl"]


def test_an_episode_that_is_held_out_stays_so_when_it_is_edited() -> None:
    held_out = sample_episode("visual_manipulation", level="L3", seed=4, domain="eval")
    scene = Composition.of(held_out).added("heart", "red", ASSETS)
    edited = scene.episode(ASSETS)
    assert (edited.task, edited.level, edited.domain) == ("composed", "L3", "eval")
    assert Composition.of(edited).episode(ASSETS) == edited
    with pytest.raises(DatasetError, match="of level L3, which stays unseen"):
        check_recordable(edited)


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


@pytest.mark.parametrize("task", REPRESENTATIVE_TASKS)
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
