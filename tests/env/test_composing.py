"""Scenes by hand: composing and clicking."""

import copy
import math
import pickle
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any  # observations and environments of all kinds

import gymnasium
import numpy as np
import pytest
from PIL import Image

import openvima
from openvima import SceneObject, compose
from openvima.catalog import load_assets
from openvima.data.user_demonstrations import check_recordable
from openvima.env import TabletopEnv, make_vec
from openvima.errors import DatasetError, InputFileError, OpenVimaError, SceneError, UnknownNameError
from openvima.perception.objects import observe_prompt_image
from openvima.render.rasteriser import Rasteriser
from openvima.render.raycast import Hit, first_hit
from openvima.scene import AtPose, InZone, ObjectImage, PhotoImage, Scene, SceneImage
from openvima.scene.action import pose_after
from openvima.studio.browser_session import clicked_action
from openvima.studio.composition import Composition, parse_goals
from openvima.tasks import sample_episode
from task_cases import REPRESENTATIVE_TASKS, frozen, full_repr, random_action

OBJECTS = [("heart", "red swirl", (0.5, -0.2)), ("bowl", "green", (0.5, 0.2))]
PROMPT = "Put the {a} into the {b}."


def refusal(*args: object, **kwargs: object) -> str:
    with pytest.raises(OpenVimaError) as caught:
        compose(*args, **kwargs)  # type: ignore[arg-type]  # wrong on purpose
    return str(caught.value)


def test_objects_rest_on_the_table_in_their_order_and_bases_are_fixed() -> None:
    heart, bowl = compose(OBJECTS, PROMPT).problem.scene.placements
    assert (heart.id, heart.object, heart.texture, heart.fixed) == (5, "heart", "red swirl", False)
    assert (bowl.id, bowl.fixed) == (6, True)
    given = [
        SceneObject("bowl", "red", (0.5, 0.3), scale=0.8, fixed=False),
        SceneObject("block", "red", (0.5, 0.0), 30),
    ]
    bowl, block = compose(given, "Look.").problem.scene.placements
    assert bowl.scale == (0.8, 0.8, 0.8) and not bowl.fixed
    assert (block.pose.z, block.pose.yaw_rad) == pytest.approx((0.034, np.pi / 6))


def test_all_forms_of_objects_mean_the_same() -> None:
    by_name = {
        "x": ("heart", "red", (0.5, 0.0), 30),
        "y": {"object": "pan", "texture": "blue", "position": [0.5, 0.3]},
    }
    records = [
        SceneObject("heart", "red", (0.5, 0.0), 30, name="x"),
        SceneObject("pan", "blue", (0.5, 0.3), name="y"),
    ]
    assert compose(by_name, "Put {x} into {y}.") == compose(records, "Put {x} into {y}.")


@pytest.mark.parametrize(
    ("objects", "words"),
    [
        ([("heart", "red", (0.8, 0.1))], ["'a' (red heart)", "(0.8, 0.1)", "0.25 … 0.75 m"]),
        ([("heart", "red", (0.74, 0.1))], ["'a' (red heart)", "with its edge", "0.25 … 0.75 m"]),
        (
            [*OBJECTS, ("star", "blue", (0.52, 0.2))],
            ["'c' (blue star)", "'b' (green bowl)", "must not cover"],
        ),
        ([("heart", "red", (float("nan"), 0.1))], ["object 0 ('a'): position is nan", "a number from"]),
        ([("heart", "red", (0.5, 0.1), 1e9)], ["yaw_deg is 1000000000.0", "-3600 to 3600"]),
        ([SceneObject("heart", "red", (0.5, 0.1), scale=9)], ["scale is 9", "0.5 to 2"]),
        ([("heart", "red")], ["object 0 ('a') has 2 entries", "(object, texture, (x, y)[, yaw_deg])"]),
        ([], ["0 objects", "1 to 64"]),
        ([SceneObject("pan", "red", (0.5, 0.1), name="../x")], ["'../x'", "letters"]),
    ],
)
def test_what_does_not_fit_is_refused_by_object_and_limit(objects: list, words: list[str]) -> None:
    message = refusal(objects, "Look.")
    assert all(word in message for word in words), message


def test_unknown_names_get_hints() -> None:
    with pytest.raises(
        UnknownNameError, match=r"object 0 \('a'\): there is no object 'hart'. Did you mean 'heart'"
    ):
        compose([("hart", "red", (0.5, 0.0))], "Look.")
    with pytest.raises(UnknownNameError, match="Did you mean 'red swirl'"):
        compose([("heart", "red swrl", (0.5, 0.0))], "Look.")
    assert "placeholder 'c'" in refusal(OBJECTS, "Put {c}.") and "a, b" in refusal(OBJECTS, "Put {c}.")
    assert "there is no placeholder in the prompt for image 'c'" in refusal(OBJECTS, PROMPT, images={"c": 0})


def test_prompt_images_come_from_the_scene_the_catalogue_and_whole_scenes() -> None:
    images = {
        "x": 0,
        "y": ("pan", "blue"),
        "z": [("a", (0.5, 0.2)), ("b", (0.5, 0.2)), ("star", "red", (0.4, -0.3))],
    }
    problem = compose(OBJECTS, "From {x} and {y} to {z} or {b}.", images=images).problem
    fills = dict(problem.prompt.images)
    assert list(fills) == ["x", "y", "z", "b"]
    assert isinstance(fills["x"], ObjectImage) and fills["x"].placement == problem.scene.placements[0]
    assert isinstance(fills["y"], ObjectImage) and fills["y"].placement.object == "pan"
    assert isinstance(fills["z"], SceneImage)
    heart, bowl, _ = fills["z"].scene.placements
    assert bowl.pose.z > heart.pose.z  # it lies on top
    assert "image 'z', object 0: there is no object 'q'" in refusal(
        OBJECTS, "{z}", images={"z": [("q", (0.5, 0.2))]}
    )


def test_a_photo_is_cut_to_its_object_and_shown_like_an_object(tmp_path: Path) -> None:
    picture = Image.new("RGB", (640, 480), "white")
    picture.paste((200, 30, 30), (100, 100, 300, 200))
    picture.save(tmp_path / "photo.png")
    problem = compose(OBJECTS, "Put {x} into {b}.", images={"x": tmp_path / "photo.png"}).problem
    photo = dict(problem.prompt.images)["x"]
    assert isinstance(photo, PhotoImage) and (photo.width, photo.height) == (48, 24)
    image = Rasteriser(load_assets("procedural")).prompt(problem.prompt).images["x"]
    seen = observe_prompt_image(image)
    assert seen.boxes[:, 0].tolist() == [[127, 75, 23, 47], [127, 62, 23, 47]]
    assert image.kind == "object" and (image.rgb["top"][0] == 200).sum() == 48 * 24
    Image.new("RGB", (9, 9), "white").save(tmp_path / "white.png")
    with pytest.raises(InputFileError, match=r"image 'x': photo .*white.png' is all white"):
        compose(OBJECTS, "Put {x}.", images={"x": tmp_path / "white.png"})


def test_goals_by_name() -> None:
    given = [
        ("in", "a", "b"),
        ("at", "a", (0.6, 0.1)),
        ("at", "a", (0.6, 0.1), 90),
        ("rotated", 0, 60),
    ]
    inside, at, turned, rotated = compose(OBJECTS, PROMPT, goals=given).problem.goals
    assert isinstance(inside, AtPose) and (inside.object_id, inside.relative_to) == (5, 6)
    assert isinstance(at, AtPose) and at.target.position[:2] == (0.6, 0.1) and at.tolerance.yaw_rad is None
    assert isinstance(turned, AtPose) and turned.target.yaw_rad == pytest.approx(np.pi / 2)
    assert isinstance(rotated, AtPose) and rotated.target.yaw_rad == pytest.approx(-np.pi / 3)
    table = [("small block", "red", (0.65, 0.1)), ("three-sided rectangle", "blue", (0.4, 0.0), -90)]
    (swept,) = compose(
        table, "Sweep.", goals=[("swept_into", "a", "b")], end_effector="spatula"
    ).problem.goals
    assert isinstance(swept, InZone) and swept.zone.size_x == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize(
    ("name", "yaw_deg", "is_met"),
    [
        ("block", 45, False),
        ("small block", 90, True),
        ("cross", 90, True),
        ("triangle", 120, False),
        ("pan", 180, False),
        ("round", 70, True),
        ("star", 72, True),
    ],
)
def test_a_heading_is_met_where_the_object_looks_the_same(name: str, yaw_deg: float, is_met: bool) -> None:
    given = {"object": name, "texture": "red", "position": (0.5, 0.0), "fixed": False}
    problem = compose([given], "Look.", goals=[("at", 0, (0.5, 0.0), yaw_deg)]).problem
    assert problem.goals[0].is_met(problem.scene) is is_met


@pytest.mark.parametrize(
    ("goal", "words"),
    [
        (("under", "a", "b"), ["there is no goal 'under'", "(in, a, b)", "(at, a, position, [yaw_deg])"]),
        (("in", "a"), ["goal 0", "(in, a, b)"]),
        ("in", ["goal 0 is 'in'; give a list of goals", "(in, a, b)"]),
        (("in", "a", "z"), ["there is no object 'z'", "a, b"]),
        (("in", "a", "a"), ["itself"]),
        (("at", "a", (0.9, 0.0)), ["(at, red swirl heart)", "0.25 … 0.75 m"]),
        (("in", "b", "a"), ["the green bowl is fixed to the table"]),
        (("rotated", "a", 3), ["degrees is 3", "15"]),
        (("swept_into", "a", "b"), ["spatula"]),
    ],
)
def test_wrong_goals_are_refused_with_the_allowed_ones(goal: object, words: list[str]) -> None:
    message = refusal(OBJECTS, PROMPT, goals=[goal])
    assert all(word in message for word in words), message


def test_the_step_limit_is_given_or_a_default() -> None:
    assert compose(OBJECTS, PROMPT).max_steps == 3
    assert compose(OBJECTS, PROMPT, goals=[("in", "a", "b")]).max_steps == 10
    assert compose(OBJECTS, PROMPT, max_steps=7).max_steps == 7
    assert "1 to 1000" in refusal(OBJECTS, PROMPT, max_steps=0)


@pytest.mark.parametrize(
    ("prompt", "text"),
    [
        ("Mets le {a} dans le {b}\u202f!", "Mets le {a} dans le {b} !"),
        ("{a}を\u3000{b}に入れてください。", "{a}を {b}に入れてください。"),
        ("{a} را در {b} بگذارید؛ آن\u200cها را.", "{a} را در {b} بگذارید؛ آن\u200cها را."),
        ("Put the {a}\ninto the {b}.\n", "Put the {a} into the {b}."),
        ("Put\tthe  {a}.\r\n", "Put the {a}."),
        ("Put  the {a}.", "Put  the {a}."),
        ("Look: \U0001f468\u200d\U0001f467 \U0001fae9", "Look: \U0001f468\u200d\U0001f467 \U0001fae9"),
    ],
)
def test_prompts_of_all_languages_are_taken_with_blanks_as_spaces(prompt: str, text: str) -> None:
    assert compose(OBJECTS, prompt).problem.prompt.text == text


def click(scene: Scene, x: float, y: float) -> Hit:
    hit = first_hit(scene.placements, (x + 0.3, y, 0.5), (-0.3, 0.0, -0.5), load_assets("procedural"))
    assert hit is not None
    return hit


def test_clicks_solve_visual_manipulation_and_the_preview_is_where_the_object_ends() -> None:
    env = TabletopEnv("visual_manipulation")
    env.reset(seed=3)
    (goal,), scene = env.episode.problem.goals, env.scene
    target, base = scene[goal.object_id], scene[goal.relative_to]
    first = click(scene, target.pose.x, target.pose.y)
    action = clicked_action(scene, first, click(scene, base.pose.x, base.pose.y), turn_rad=math.radians(30))
    assert first.object_id == target.id
    expected = pose_after(target.pose, action)
    assert expected.yaw_rad == pytest.approx(target.pose.yaw_rad + math.radians(30), abs=1e-6)
    env.step(action)
    assert env.outcome.success
    assert env.scene[target.id].pose.planar_distance(expected) < 0.02  # it settles in its base


def test_a_block_that_is_clicked_is_swept_from_behind() -> None:
    objects = [("small block", "red", (0.5, 0.1)), ("three-sided rectangle", "blue", (0.5, -0.2))]
    goals = [("swept_into", "a", "b")]
    episode = openvima.compose(objects, "Sweep {a}.", goals=goals, end_effector="spatula")
    env = TabletopEnv("rotate")
    env.reset(options={"episode": episode})
    action = clicked_action(env.scene, click(env.scene, 0.5, 0.1), Hit(0, (0.5, -0.23, 0.0)))
    assert action.pose0_position == pytest.approx((0.5, 0.106))
    env.step(action)
    assert env.outcome.success
    beside = clicked_action(env.scene, Hit(0, (0.4, 0.1, 0.0)), Hit(0, (0.4, -0.1, 0.0)))
    assert beside.pose0_position == pytest.approx((0.4, 0.1))


def test_what_cannot_be_picked_is_said() -> None:
    scene = sample_episode("visual_manipulation", seed=3).problem.scene
    fixed = next(p for p in scene.placements if p.fixed)
    with pytest.raises(SceneError, match="no object at"):
        clicked_action(scene, Hit(0, (0.3, 0.4, 0.0)), Hit(0, (0.5, 0.0, 0.0)))
    with pytest.raises(SceneError, match="is fixed to the table"):
        clicked_action(scene, Hit(fixed.id, (0.3, 0.4, 0.0)), Hit(0, (0.5, 0.0, 0.0)))


ASSETS = load_assets("procedural")
OBJECTS_COMPOSITION = {
    "heart": ("heart", "red", (0.45, -0.25), 40.0),
    "bowl": ("bowl", "green", (0.55, 0.25)),
}
EPISODE = compose(OBJECTS_COMPOSITION, "Put the {heart} into the {bowl}.", goals=[("in", "heart", "bowl")])


def test_a_composition_is_the_episode_that_it_came_from() -> None:
    scene = Composition.of(EPISODE)
    assert scene.episode(ASSETS) == EPISODE
    assert scene.goals_text == "[in, heart, bowl]" and parse_goals(scene.goals_text) == scene.goals
    asked = Composition(scene.objects, "Rearrange to {goal}.", {"goal": scene.scene_image()})
    (image,) = dict(asked.episode(ASSETS).problem.prompt.images).values()
    assert [p.object for p in image.scene.placements] == ["heart", "bowl"]


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


def test_an_episode_that_is_held_out_stays_so_when_it_is_edited() -> None:
    held_out = sample_episode("visual_manipulation", level="L3", seed=4, domain="eval")
    scene = Composition.of(held_out).added("heart", "red", ASSETS)
    edited = scene.episode(ASSETS)
    assert (edited.task, edited.level, edited.domain) == ("composed", "L3", "eval")
    assert Composition.of(edited).episode(ASSETS) == edited
    with pytest.raises(DatasetError, match=r"L3, eval seed 0\) stays unseen"):
        check_recordable(edited)


COPIES = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


@pytest.fixture(params=COPIES)
def copied(request: pytest.FixtureRequest) -> Callable[[Any], Any]:
    return COPIES[request.param]


def steps(env: gymnasium.Env, rng: np.random.Generator, is_over: bool) -> list[int]:
    """Checksums of all that is seen of further random steps until the end, and of the next episode."""
    seen = [(env.unwrapped.scene, env.unwrapped.joint_path, env.render())]
    while not is_over:
        result = env.step(random_action(rng, env.unwrapped.scene))
        seen.append((result, env.unwrapped.scene))
        is_over = result[2] or result[3]
    return [zlib.crc32(repr(frozen(entry)).encode()) for entry in (*seen, env.reset())]


@pytest.mark.parametrize("task", REPRESENTATIVE_TASKS[::3])
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
    assert frozen(results[0]) == frozen(results[1])
    for view, shown in results[0][0]["rgb"].items():
        assert not np.shares_memory(shown, results[1][0]["rgb"][view])
