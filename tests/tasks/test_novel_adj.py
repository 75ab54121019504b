"""Scenes, prompts and outcomes of `novel_adj` follow its specification."""

import itertools
import re
from typing import NamedTuple

import numpy as np
import pytest

from openvima.catalog import Assets
from openvima.catalog.textures import texture_spec
from openvima.render.rasteriser import Rasteriser
from openvima.scene import Action, ObjectImage, Placement, Pose, Problem, Scene
from openvima.sim.world import World
from openvima.tasks import sample_episode
from task_cases import assert_judged_at_its_limits, assert_uniform, roles, roles_with_twins

TASK = "novel_adj"
NUM_EPISODES = 1000
WORDS = ("daxer", "blicker", "modier", "kobar")
MEANINGS = ("shorter", "taller", "lighter", "darker")
SENTENCES = (
    "{demo_blicker_obj_1} is WORD than {demo_less_blicker_obj_1}. "
    "{demo_blicker_obj_2} is WORD than {demo_less_blicker_obj_2}. "
    "{demo_blicker_obj_3} is WORD than {demo_less_blicker_obj_3}. "
    "Put the WORD {dragged_obj} into the {base_obj}."
)


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, seed=seed).problem for seed in range(NUM_EPISODES)]


class Asked(NamedTuple):
    """What a prompt says, read off its text and its pictures."""

    word: str
    is_flipped: bool
    meaning: str
    shown: dict[str, Placement]


def read(problem: Problem) -> Asked:
    match = re.search(r"Put the (less )?(\w+) ", problem.prompt.text)
    assert match is not None
    shown = {}
    for name, image in problem.prompt.images:
        assert isinstance(image, ObjectImage)
        shown[name] = image.placement
    more, less = shown["demo_blicker_obj_1"], shown["demo_less_blicker_obj_1"]
    return Asked(match[2], match[1] is not None, difference(more, less), shown)


def difference(first: Placement, second: Placement) -> str:
    """What the first is compared with the second; they must be the same but for that."""
    assert (first.object, first.size) == (second.object, second.size)
    if first.scale != second.scale:
        assert first.texture == second.texture
        axis = 0 if first.scale[0] != second.scale[0] else 2
        words = ("smaller", "larger") if axis == 0 else ("shorter", "taller")
        return words[first.scale[axis] > second.scale[axis]]
    assert first.scale == (1.0, 1.0, 1.0)
    assert texture_spec(first.texture).light_variant == texture_spec(second.texture).light_variant
    assert texture_spec(first.texture).is_dark is not texture_spec(second.texture).is_dark
    return ("lighter", "darker")[texture_spec(first.texture).is_dark]


@pytest.mark.slow
def test_word_meaning_and_less_are_uniform_and_independent(problems: list[Problem]) -> None:
    asked = [read(problem) for problem in problems]
    combinations = list(itertools.product(WORDS, (False, True), MEANINGS))
    assert_uniform([(a.word, a.is_flipped, a.meaning) for a in asked], combinations)


@pytest.mark.slow
def test_the_prompt_is_the_published_text_with_one_space_between_words(problems: list[Problem]) -> None:
    for problem in problems:
        asked = read(problem)
        expected = SENTENCES.replace("WORD", asked.word)
        if asked.is_flipped:
            expected = expected.replace("Put the", "Put the less")
        assert problem.prompt.text == expected


@pytest.mark.slow
def test_the_twins_differ_as_the_comparisons_do_and_the_right_one_is_asked_for(
    problems: list[Problem],
) -> None:
    opposite = {"shorter": "taller", "taller": "shorter", "lighter": "darker", "darker": "lighter"}
    for problem in problems:
        asked = read(problem)
        target, _, (twin,) = roles(problem)
        wanted = opposite[asked.meaning] if asked.is_flipped else asked.meaning
        assert difference(target, twin) == wanted


@pytest.mark.slow
def test_all_comparisons_show_the_same_and_by_as_much_as_on_the_table(problems: list[Problem]) -> None:
    factors = []
    for problem in problems:
        asked = read(problem)
        target, _, (twin,) = roles(problem)
        scales = sorted((target.scale, twin.scale))
        for n in (1, 2, 3):
            pair = (asked.shown[f"demo_blicker_obj_{n}"], asked.shown[f"demo_less_blicker_obj_{n}"])
            assert difference(*pair) == asked.meaning
            assert sorted(p.scale for p in pair) == scales
        if asked.meaning in ("shorter", "taller"):
            (x, y, low), (_, _, high) = scales
            assert x == y == 1 and 0.3 <= low < 0.4 and high - low == pytest.approx(2.0, abs=1e-12)
            factors.append(low)
    deciles = np.floor((np.array(factors) - 0.3) / 0.01).astype(int)
    assert_uniform(deciles.tolist(), range(10))


@pytest.mark.slow
def test_gray_pictures_hold_no_colour_of_the_texture(problems: list[Problem], assets: Assets) -> None:
    rendered = Rasteriser(assets).prompt(problems[0].prompt)
    for name in ("dragged_obj", "base_obj"):
        image = rendered.images[name]
        assert [record.texture for record in image.objects] == ["gray"]
        for view, segm in image.segm.items():
            red, green, blue = image.rgb[view][:, segm == 0].astype(float)
            # One hue and only one: what varies is the light.
            assert (
                np.abs(green / red - 176 / 186).max() < 0.02 and np.abs(blue / red - 172 / 186).max() < 0.02
            )


@pytest.mark.slow
def test_a_base_and_two_movable_twins_stand_apart(problems: list[Problem]) -> None:
    for problem in problems:
        target, base, (twin,) = roles(problem)
        assert len(problem.scene.placements) == 3
        assert base.fixed and not target.fixed and not twin.fixed
        assert target.pose.planar_distance(twin.pose) >= 0.1
        for placement in (target, twin):
            distance = placement.pose.planar_distance(base.pose)
            assert distance >= 0.1
            if base.object in ("frame", "square"):
                sides = [(placement.size[i] + base.size[i]) / 2 + 0.01 for i in (0, 1)]
                assert distance > max(sides)


@pytest.mark.parametrize("level", ["train", "L3"])
@pytest.mark.slow
def test_outcomes_change_at_the_limits(level: str) -> None:
    for seed in range(25):
        problem = sample_episode(TASK, level=level, seed=seed, difficulty="hard", num_distractors=1).problem
        assert_judged_at_its_limits(problem)


@pytest.mark.parametrize("difficulty", ["medium", "hard"])
def test_beyond_easy_another_shape_is_like_one_of_the_twins(difficulty: str) -> None:
    for seed in range(100):
        problem = sample_episode(TASK, seed=seed, difficulty=difficulty).problem
        target, _, twin, (extra,) = roles_with_twins(problem)
        like = target if difficulty == "hard" else twin
        assert extra.object != target.object and not extra.fixed
        assert (extra.texture, extra.scale) == (like.texture, like.scale)


@pytest.mark.parametrize("factor", [0.3, 2.4])
@pytest.mark.parametrize("object_name", ["letter E", "letter V", "ring", "triangle", "star", "letter T"])
def test_short_and_tall_objects_can_be_lifted_and_stand(
    assets: Assets, object_name: str, factor: float
) -> None:
    scale, size = (1.0, 1.0, factor), (0.144, 0.144, 0.036)
    start = Pose.planar(0.45, -0.2, 0.4)
    world = World(Scene((Placement(5, object_name, "red", size, start, scale=scale),)), assets)
    x, y, _ = start.transform(np.array([_inside(assets, object_name)]))[0]
    execution = world.execute(Action.planar((x, y), (x, y + 0.4), 1.0))
    end = world.scene[5].pose
    assert execution.grasped == 5
    qx, qy, _, _ = end.quaternion
    assert end.z == pytest.approx(0, abs=1e-4) and abs(qx) + abs(qy) < 1e-3


def _inside(assets: Assets, object_name: str) -> tuple[float, float, float]:
    """A point of an object's outer rim, seen from above."""
    vertices = assets.geometry(object_name, (0.144, 0.144, 0.036)).visual.vertices
    upward = vertices[np.ptp(vertices[..., 2], axis=1) == 0]
    x, y, _ = upward[0].mean(axis=0).tolist()
    return x, y, 0.0
