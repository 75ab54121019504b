"""Scenes are edited one change at a time."""

import pytest

from openvima import compose
from openvima.catalog import load_assets
from openvima.data.user_demonstrations import check_recordable
from openvima.env.composition import Composition, parse_goals
from openvima.errors import DatasetError, SceneError, UnknownObjectError
from openvima.tasks import sample_episode

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
    with pytest.raises(UnknownObjectError):
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


def test_sampled_episodes_are_edited_too() -> None:
    scene = Composition.of(sample_episode("visual_manipulation", seed=4))
    (goal,) = scene.goals
    assert goal[0] == "in" and scene.removed(scene.objects[-1].name)


def test_an_episode_that_is_held_out_stays_so_when_it_is_edited() -> None:
    held_out = sample_episode("visual_manipulation", level="L3", seed=4, domain="eval")
    scene = Composition.of(held_out).added("heart", "red", ASSETS)
    edited = scene.episode(ASSETS)
    assert (edited.task, edited.level, edited.domain) == ("composed", "L3", "eval")
    assert Composition.of(edited).episode(ASSETS) == edited
    with pytest.raises(DatasetError, match="of level L3, which stays unseen"):
        check_recordable(edited)


@pytest.mark.parametrize("text", ["in, a, b", "[in, a", "{a: b}", "!!python/name:os.system"])
def test_goals_in_another_form_are_refused(text: str) -> None:
    with pytest.raises(SceneError, match="write them as"):
        parse_goals(text)
