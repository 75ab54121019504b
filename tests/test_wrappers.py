"""Wrappers for libraries of reinforcement learning."""

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import openvima
from openvima.errors import ActionError, ConfigError, PolicyError
from openvima.scene import Action
from openvima.tasks import task_spec
from openvima.wrappers import FlatAction, FlatObservation, ImageObservation, ProgressReward


# The two have the most objects: in the prompt's images, and on the table.
@pytest.mark.parametrize("task", ["rotate", "imitate_then_undo", "sweep_without_exceeding"])
def test_gymnasium_finds_nothing_to_complain_about(task: str) -> None:
    env = openvima.make(task, level=task_spec(task).levels[-1])
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version")
        check_env(ProgressReward(FlatObservation(FlatAction(env))), skip_render_check=True)


@pytest.mark.parametrize("task", ["twist", "sweep_without_exceeding"])
def test_the_oracle_solves_tasks_by_flat_actions(task: str) -> None:
    env = ProgressReward(FlatAction(openvima.make(task)))
    num_solved, returns = 0, []
    for seed in range(3):
        _, info = env.reset(seed=seed)
        first, is_over, total = info["progress"], False, 0.0
        while not is_over:
            action = FlatAction.flatten(env.unwrapped.oracle_decision().action)
            assert env.action_space.contains(action)
            *_, reward, terminated, truncated, info = env.step(action)
            total, is_over = total + float(reward), terminated or truncated
        num_solved += info["success"]
        gain = 1 + first["distance_m"] + 0.1 * first["angle_rad"]
        returns.append(total == pytest.approx(1 + gain))
    assert num_solved == 3 and all(returns)
    assert Action.from_arrays(env.get_wrapper_attr("action")(np.zeros(6))).yaw1_rad == 0


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(5), r"0\.\]\); it must be an array of 6 floating-point numbers"),
        (np.zeros(6, int), "floating-point"),
        (np.full(6, np.nan), "nan"),
        (np.array([0, 0, 0, 1.5, 0, 0]), r"1\.5.*each in -1 … 1"),
    ],
)
def test_invalid_flat_actions_are_refused(action: np.ndarray, message: str) -> None:
    env = FlatAction(openvima.make("rotate"))
    env.reset(seed=0)
    with pytest.raises(ActionError, match=message):
        env.step(action)


def test_rows_hold_what_lies_on_the_table_and_what_the_prompt_shows() -> None:
    env = FlatObservation(openvima.make("visual_manipulation"))
    objects, prompt, words = env.rows(env.reset(seed=3)[0])
    scene = env.unwrapped.scene
    places = sorted((p.pose.y, p.pose.x) for p in scene.placements)
    assert objects[:, 0].tolist() == [1.0] * len(places) + [0.0] * (18 - len(places))
    seen = [(y * 0.5, 0.5 + x * 0.25) for x, y in objects[: len(places), 1:3]]
    assert np.abs(np.array(seen) - places).max() < 0.03
    assert prompt[:3, 0].tolist() == [1, 1, 0] and not prompt[:, 1:3].any()
    assert prompt[:2, 5] == pytest.approx([0, 1 / 18])
    shown = [prompt[:, 8:] @ row[8:] / np.linalg.norm(row[8:]) for row in objects[: len(places)]]
    assert len({int(np.argmax(each)) for each in np.transpose(shown)[:2]}) == 2
    assert words.sum() == 3  # put, the, into


def test_the_tool_and_where_to_pick_are_seen_under_low_level_control() -> None:
    env = FlatObservation(openvima.make("rotate", control="end_effector"))
    observation, info = env.reset(seed=0)
    while not info["grasped"]:
        observation, *_, info = env.step(env.unwrapped.oracle_command())
    objects, _, words = env.rows(observation)
    x, y, z, *yaw_and_hold = words[65:]
    assert env.observation_space.contains(observation) and yaw_and_hold == pytest.approx([0, 1, 1])
    assert np.abs(objects[:2, 6:8] - (x, y)).max(axis=1).min() < 0.15  # 4 cm
    assert 0.01 < (z + 1) / 2 * 0.35 < 0.06
    with pytest.raises(ConfigError, match="control is 'end_effector', whose actions are a box already"):
        FlatAction(openvima.make("rotate", control="end_effector"))


def test_images_and_words_are_a_flat_dictionary() -> None:
    env = ImageObservation(FlatAction(openvima.make("visual_manipulation")))
    observation, _ = env.reset(seed=3)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*different from the unwrapped version")
        check_env(env, skip_render_check=True)
    shapes = {name: value.shape for name, value in observation.items()}
    assert shapes == {"front": (3, 64, 128), "top": (3, 64, 128), "prompt": (12, 64, 128), "words": (65,)}
    observation, _ = env.reset(seed=3)
    seen = env.unwrapped.observe()["rgb"]["top"]
    assert (
        observation["top"][:, 5, 7].tolist() == seen[:, 10:12, 14:16].mean(axis=(1, 2)).astype(int).tolist()
    )
    first, second, rest = observation["prompt"][:3], observation["prompt"][3:6], observation["prompt"][6:]
    assert not np.array_equal(first, second) and second.any() and not rest.any()
    assert np.array_equal(observation["words"], FlatObservation(env.env).reset(seed=3)[0][-65:])
    too_few = ImageObservation(openvima.make("visual_manipulation"), max_prompt_images=1)
    with pytest.raises(ConfigError, match="max_prompt_images is 1, but the prompt has 2; give more"):
        too_few.reset(seed=3)
    tool = ImageObservation(openvima.make("rotate", control="end_effector"))
    assert tool.observation_space.contains(tool.reset(seed=0)[0])


def test_the_reward_sees_how_far_from_its_object_an_action_picks() -> None:
    env = ProgressReward(FlatAction(openvima.make("rotate", num_distractors=1)), reach_weight=2.0)
    rewards = []
    for offset_m in (0.2, 0.1):
        env.reset(seed=2)
        (goal,) = env.unwrapped.episode.problem.goals
        pose = env.unwrapped.scene[goal.object_id].pose
        x = pose.x + offset_m * (1 if pose.x < 0.5 else -1)
        action = FlatAction.flatten(Action.planar((x, pose.y), (x, pose.y)))
        _, reward, *_, info = env.step(action)
        assert not info["grasped"] and not info["success"]
        rewards.append(reward)
    assert rewards == pytest.approx([-0.4, -0.2], abs=1e-5)


def test_the_reward_sees_the_tool_near_its_object() -> None:
    """As a potential, so that going there and back earns nothing."""
    base = openvima.make("rotate", control="end_effector", num_distractors=0)
    env = ProgressReward(base, reach_weight=1.0)
    env.reset(seed=0)
    (goal,) = base.episode.problem.goals

    def distance() -> float:
        pose = base.scene[goal.object_id].pose
        return float(np.hypot(pose.x - base.tool[0], pose.y - base.tool[1]))

    before, total = distance(), 0.0
    for sign in (1, 1, 1, -1):
        total += env.step(np.array([0, 0.04 * sign, 0, 0, 0], np.float32))[1]
    assert distance() != pytest.approx(before) and total == pytest.approx(before - distance(), abs=1e-5)
    with pytest.raises(ConfigError, match="commands need control 'end_effector'"):
        primitives = openvima.make("rotate")
        primitives.reset(seed=0)
        _ = primitives.tool


def test_words_tell_prompts_of_one_task_apart() -> None:
    env = FlatObservation(openvima.make("rotate"))
    angles = {}
    for seed in range(20):
        observation, info = env.reset(seed=seed)
        angles.setdefault(info["prompt"].split()[-2], set()).add(env.rows(observation)[2].tobytes())
    assert len(angles) > 3 and all(len(words) == 1 for words in angles.values())
    assert len(set.union(*angles.values())) == len(angles)


def test_too_few_rows_and_missing_images_are_named() -> None:
    env = FlatObservation(openvima.make("visual_manipulation"), max_objects=2)
    with pytest.raises(ConfigError, match="max_objects is 2, but there are 3 objects; give more rows"):
        env.reset(seed=0)
    with pytest.raises(PolicyError, match="segm"):
        FlatObservation(openvima.make("rotate", modalities=("rgb",))).reset(seed=0)


def test_the_code_of_the_page_runs_from_top_to_bottom(capsys: pytest.CaptureFixture[str]) -> None:
    page = Path(__file__).parents[1] / "docs" / "reinforcement_learning.md"
    names: dict[str, object] = {}
    for code in re.findall(
        r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    ):
        exec(compile(code, str(page), "exec"), names)
    printed = capsys.readouterr().out
    assert "2 objects, the leftmost" in printed and f"(4, {18 * 56 * 2 + 65})" in printed
