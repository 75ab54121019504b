"""Scenes and prompts of `novel_noun`, `novel_adj` and `novel_adj_and_noun` follow their specification."""

import collections
import functools
import itertools
import re

import numpy as np
import pytest

from openvima.catalog import pool
from openvima.catalog.textures import texture_spec
from openvima.scene import ObjectImage, Placement, Problem
from openvima.tasks import sample_episode
from task_cases import assert_frequencies, assert_uniform, roles, roles_with_twins

NUM_EPISODES = 1000
LEVELS = {"novel_noun": "train", "novel_adj": "train", "novel_adj_and_noun": "L4"}
WORDS = ("daxer", "blicker", "modier", "kobar")
NOUNS = ("dax", "blicket", "wug", "zup")
MEANINGS = ("shorter", "taller", "lighter", "darker")
LESSON = " ".join(f"{{demo_blicker_obj_{n}}} is WORD than {{demo_less_blicker_obj_{n}}}." for n in (1, 2, 3))
REQUESTS = {
    "novel_noun": "Put a {target} into a {base}.",
    "novel_adj": f"{LESSON} Put the WORD {{dragged_obj}} into the {{base_obj}}.",
    "novel_adj_and_noun": f"{LESSON} Put the WORD {{target}} into the {{base}}.",
}
both_nouns = pytest.mark.parametrize("task", ["novel_noun", "novel_adj_and_noun"])


@functools.cache
def problems(task: str) -> list[Problem]:
    return [sample_episode(task, level=LEVELS[task], seed=seed).problem for seed in range(NUM_EPISODES)]


@both_nouns
@pytest.mark.slow
def test_two_different_nouns_are_introduced_in_either_order(task: str) -> None:
    forms, pairs = [], []
    for problem in problems(task):
        introduced = re.findall(r"This is a (\w+) \{(dragged|base)_obj(?:_1)?\}\.", problem.prompt.text)
        forms.append([role for _, role in introduced] == ["dragged", "base"])
        noun = {role: word for word, role in introduced}
        request = REQUESTS[task].replace("{target}", noun["dragged"]).replace("{base}", noun["base"])
        if task == "novel_adj_and_noun":
            request = worded(request, *word_of(problem))
        assert problem.prompt.text.split(". ", 2)[2] == request
        pairs.append((noun["dragged"], noun["base"]))
    assert_uniform(forms, (True, False))
    assert_uniform(pairs, [(a, b) for a in NOUNS for b in NOUNS if a != b])


@pytest.mark.parametrize("task", LEVELS)
@pytest.mark.slow
def test_gray_pictures_introduce_target_and_base_once_each(task: str) -> None:
    target_slot = "dragged_obj_1" if task == "novel_noun" else "dragged_obj"
    for problem in problems(task):
        images = dict(problem.prompt.images)
        assert len(images) == (2 if task == "novel_noun" else 8)
        for name, original in zip((target_slot, "base_obj"), roles(problem)[:2], strict=True):
            assert problem.prompt.text.count("{" + name + "}") == 1
            assert isinstance(images[name], ObjectImage)
            shown = images[name].placement
            assert (shown.object, shown.size, shown.texture, shown.scale) == (
                *(original.object, original.size, "gray", (1, 1, 1)),
            )
            assert original.texture != "gray"


@pytest.mark.slow
def test_a_distractor_has_a_third_shape_and_is_fixed_if_a_base() -> None:
    base_shapes = pool("novel_noun", "train").base_objects
    num_bases = 0
    for problem in problems("novel_noun"):
        target, base, (distractor,) = roles(problem)
        assert distractor.object not in (target.object, base.object)
        assert base.fixed and not target.fixed
        assert distractor.fixed is (distractor.object in base_shapes)
        num_bases += distractor.fixed
    assert 0.13 < num_bases / NUM_EPISODES < 0.21  # 3 of 16 shapes, some of them harder to place


def word_of(problem: Problem) -> tuple[str, bool]:
    """The adjective that is asked for, and whether there is less of it."""
    match = re.search(r"Put the (less )?(\w+) ", problem.prompt.text)
    assert match is not None
    return match[2], match[1] is not None


def worded(request: str, word: str, is_flipped: bool) -> str:
    return request.replace("Put the", "Put the less" if is_flipped else "Put the").replace("WORD", word)


def read(problem: Problem) -> tuple[str, bool, str, dict[str, Placement]]:
    """Word, whether there is less of it, its meaning, and the images, read off text and pictures."""
    shown = {name: image.placement for name, image in problem.prompt.images if isinstance(image, ObjectImage)}
    more, less = shown["demo_blicker_obj_1"], shown["demo_less_blicker_obj_1"]
    return *word_of(problem), difference(more, less), shown


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
def test_the_prompt_means_the_twin_that_it_says_and_its_words_are_uniform() -> None:
    opposite = {"shorter": "taller", "taller": "shorter", "lighter": "darker", "darker": "lighter"}
    drawn = []
    for problem in problems("novel_adj"):
        word, is_flipped, meaning, _ = read(problem)
        assert problem.prompt.text == worded(REQUESTS["novel_adj"], word, is_flipped)
        target, _, (twin,) = roles(problem)
        assert difference(target, twin) == (opposite[meaning] if is_flipped else meaning)
        drawn.append((word, is_flipped, meaning))
    assert_uniform(drawn, itertools.product(WORDS, (False, True), MEANINGS))


@pytest.mark.slow
def test_all_comparisons_show_the_same_and_by_as_much_as_on_the_table() -> None:
    factors = []
    for problem in problems("novel_adj"):
        *_, meaning, shown = read(problem)
        target, _, (twin,) = roles(problem)
        scales = sorted((target.scale, twin.scale))
        for n in (1, 2, 3):
            pair = (shown[f"demo_blicker_obj_{n}"], shown[f"demo_less_blicker_obj_{n}"])
            assert difference(*pair) == meaning
            assert sorted(p.scale for p in pair) == scales
        if meaning in ("shorter", "taller"):
            (x, y, low), (_, _, high) = scales
            assert x == y == 1 and 0.3 <= low < 0.4 and high - low == pytest.approx(2.0, abs=1e-12)
            factors.append(low)
    assert_uniform(np.floor((np.array(factors) - 0.3) / 0.01).astype(int).tolist(), range(10))


@pytest.mark.slow
def test_a_base_and_two_movable_twins_stand_apart() -> None:
    for problem in problems("novel_adj"):
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


@pytest.mark.parametrize("difficulty", ["medium", "hard"])
def test_beyond_easy_another_shape_is_like_one_of_the_twins(difficulty: str) -> None:
    for seed in range(15):
        problem = sample_episode("novel_adj", seed=seed, difficulty=difficulty).problem
        target, _, twin, (extra,) = roles_with_twins(problem)
        like = target if difficulty == "hard" else twin
        assert extra.object != target.object and not extra.fixed
        assert (extra.texture, extra.scale) == (like.texture, like.scale)


@pytest.mark.slow
def test_five_bodies_stand_apart_and_distractors_draw_from_both_lists_put_together() -> None:
    drawn_from = pool("novel_adj_and_noun", "L4")
    entries = collections.Counter((*drawn_from.dragged_textures, *drawn_from.base_textures))
    assert entries.total() == 91 and collections.Counter(entries.values()) == {1: 53, 2: 19}
    words, textures = [], []
    for problem in problems("novel_adj_and_noun"):
        placements = problem.scene.placements
        assert len(placements) == 5
        assert all(
            placement.fixed is (placement.object in drawn_from.base_objects) for placement in placements
        )
        target, base, twin, others = roles_with_twins(problem)
        assert (twin.object, twin.size) == (target.object, target.size)
        assert not {other.object for other in others} & {base.object, target.object}
        for anchor, other in itertools.product((target, base), (twin, *others)):
            assert anchor.pose.planar_distance(other.pose) >= 0.1
        words.append(word_of(problem))
        textures += [other.texture for other in others]
    assert_uniform(words, itertools.product(WORDS, (False, True)))
    assert_frequencies(textures, {texture: count / 91 for texture, count in entries.items()})
