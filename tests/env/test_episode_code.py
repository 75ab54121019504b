"""Episodes as arguments of `compose`, as Python and as commands."""

import shlex
import subprocess
from pathlib import Path

import pytest
from PIL import Image

import openvima
from openvima.env import EnvConfig
from openvima.env.composition import compose_values, python_code, shell_command
from openvima.errors import SceneError
from openvima.scene import Episode
from openvima.tasks import sample_episode

OBJECTS = {
    "block": ("block", "red", (0.45, -0.25)),
    "bowl": ("bowl", "green", (0.55, 0.25)),
    "a": {"object": "heart", "texture": "blue", "position": (0.6, -0.05), "yaw_deg": 40.0, "scale": 0.9},
}
PROMPT = "Put the {block} or a {star} into the {bowl} so that it is like {picture}."
IMAGES = {"star": ("star", "yellow"), "picture": [("block", (0.5, 0.1)), ("star", "yellow", (0.4, 0.3), 10)]}
GOALS = [("in", "block", "bowl"), ("rotated", "a", 60), ("at", "block", (0.5, 0.1), 30)]


def composed() -> Episode:
    return openvima.compose(OBJECTS, PROMPT, images=IMAGES, goals=GOALS, max_steps=4)


def run(code: str) -> Episode:
    """Execute the code that makes an episode, without playing it."""
    values: dict = {}
    exec(code.partition("result =")[0], values)
    return values["episode"]


def test_a_composed_episode_gives_its_arguments_back() -> None:
    values = compose_values(composed())
    assert values["objects"] == OBJECTS and values["prompt"] == PROMPT and values["goals"][:2] == GOALS[:2]
    assert openvima.compose(**values) == composed()


@pytest.mark.parametrize("task", ["visual_manipulation", "rotate", "scene_understanding", "rearrange"])
def test_a_sampled_episode_can_be_changed(task: str) -> None:
    episode = sample_episode(task, seed=2)
    again = openvima.compose(**compose_values(episode))
    pairs = list(zip(episode.problem.scene.placements, again.problem.scene.placements, strict=True))
    assert all(old.pose.planar_distance(new.pose) < 1e-5 and old.object == new.object for old, new in pairs)
    assert len(again.problem.goals) == len(episode.problem.goals)
    assert again.problem.prompt.text == episode.problem.prompt.text


def test_goals_without_a_composed_form_are_named() -> None:
    class Own:
        def is_met(self, scene: object) -> bool:
            return False

    with pytest.raises(SceneError, match="goal 0 is a Own"):
        compose_values(openvima.compose(OBJECTS, "Look.", goals=[Own()]))


def test_python_makes_the_same_episode(tmp_path: Path) -> None:
    assert run(python_code(composed())) == composed()
    assert "openvima.compose(" in python_code(composed())
    sampled = sample_episode("rotate", seed=3, domain="eval", difficulty="hard")
    config = EnvConfig(task_options="rotate.difficulty=hard")
    code = python_code(sampled, policy="runs/mine", env_config=config)
    assert run(code) == sampled
    assert "sample_episode('rotate', level='train', seed=3, domain='eval', difficulty='hard')" in code
    assert "openvima.play(episode, 'runs/mine')" in code
    hovering = sample_episode("rotate", seed=3, compat=True)
    code = python_code(hovering, env_config=EnvConfig(compat=True))
    assert run(code) == hovering and "openvima.play(episode, 'openvima-small', compat=True)" in code
    Image.new("RGB", (80, 50), "red").save(tmp_path / "photo.png")
    photo = openvima.compose(OBJECTS, "Put the {p}.", images={"p": tmp_path / "photo.png"})
    assert run(python_code(photo)) == photo


def test_commands_name_or_hold_the_episode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sampled = sample_episode("rotate", level="L2", seed=3)
    assert shell_command(sampled) == (
        "openvima demo rotate --level L2 --seed 3 --policy openvima-small --out rotate.mp4\n"
    )
    monkeypatch.chdir(tmp_path)
    evaluated = sample_episode("rotate", level="L2", seed=3, domain="eval")
    for episode in (composed(), evaluated):
        text, _, command = shell_command(episode, policy="my run").rpartition("END\n")
        subprocess.run(["bash", "-c", text + "END\n"], check=True)
        assert shlex.split(command)[:6] == [
            "openvima",
            "demo",
            "--episode",
            "episode.yaml",
            "--policy",
            "my run",
        ]
        assert openvima.load_episode("episode.yaml") == episode
