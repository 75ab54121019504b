"""Episodes as arguments of `compose`."""

from dataclasses import replace

import pytest

import openvima
from openvima.catalog import load_assets
from openvima.env.composing import scene_objects
from openvima.errors import SceneError
from openvima.scene import Episode
from openvima.studio.composition import Composition
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


def test_a_composed_episode_gives_its_arguments_back() -> None:
    again = Composition.of(composed())
    assert [replace(each, fixed=None) for each in again.objects] == scene_objects(OBJECTS)
    assert again.prompt == PROMPT and list(again.goals[:2]) == GOALS[:2]
    assert again.episode(load_assets()) == composed()


@pytest.mark.parametrize("task", ["visual_manipulation", "rotate", "scene_understanding", "rearrange"])
def test_a_sampled_episode_can_be_changed(task: str) -> None:
    episode = sample_episode(task, seed=2)
    again = Composition.of(episode).episode(load_assets())
    pairs = list(zip(episode.problem.scene.placements, again.problem.scene.placements, strict=True))
    assert all(old.pose.planar_distance(new.pose) < 1e-5 and old.object == new.object for old, new in pairs)
    assert len(again.problem.goals) == len(episode.problem.goals)
    assert again.problem.prompt.text == episode.problem.prompt.text


def test_goals_without_a_composed_form_are_named() -> None:
    class Own:
        def is_met(self, scene: object) -> bool:
            return False

    with pytest.raises(SceneError, match="goal 0 is a Own"):
        Composition.of(openvima.compose(OBJECTS, "Look.", goals=[Own()]))
