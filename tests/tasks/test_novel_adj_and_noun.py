"""Scenes, prompts and outcomes of `novel_adj_and_noun` follow its specification."""

import collections
import re

import pytest

from openvima.catalog import pool
from openvima.scene import ObjectImage, Problem
from openvima.tasks import sample_episode
from task_cases import (
    assert_frequencies,
    assert_judged_at_its_limits,
    assert_uniform,
    roles,
    roles_with_twins,
)

TASK = "novel_adj_and_noun"
NUM_EPISODES = 1000
ADJECTIVES = ("daxer", "blicker", "modier", "kobar")
NOUNS = ("dax", "blicket", "wug", "zup")
LESSON = " ".join(
    rf"\{{demo_blicker_obj_{n}\}} is (?P<adjective{n}>\w+) than \{{demo_less_blicker_obj_{n}\}}\."
    for n in (1, 2, 3)
)
REQUEST = r"Put the (?P<less>less )?(?P<adjective>\w+) (?P=target) into the (?P=base)\."
TARGET_INTRODUCED = r"This is a (?P<target>\w+) \{dragged_obj\}\."
BASE_INTRODUCED = r"This is a (?P<base>\w+) \{base_obj\}\."
FORMS = {
    "target first": f"{TARGET_INTRODUCED} {BASE_INTRODUCED} {LESSON} {REQUEST}",
    "base first": f"{BASE_INTRODUCED} {TARGET_INTRODUCED} {LESSON} {REQUEST}",
}


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, level="L4", seed=seed).problem for seed in range(NUM_EPISODES)]


def matched(problem: Problem) -> tuple[str, re.Match[str]]:
    """Which form the prompt has, and its words."""
    (found,) = [(n, match) for n, form in FORMS.items() if (match := re.fullmatch(form, problem.prompt.text))]
    return found


@pytest.mark.slow
def test_words_and_order_of_introductions_are_uniform(problems: list[Problem]) -> None:
    forms, matches = zip(*map(matched, problems), strict=True)
    assert_uniform(forms, FORMS)
    assert all({match[f"adjective{n}"] for n in (1, 2, 3)} == {match["adjective"]} for match in matches)
    assert_uniform(
        [(match["adjective"], match["less"]) for match in matches],
        [(word, less) for word in ADJECTIVES for less in (None, "less ")],
    )
    pairs = [(a, b) for a in NOUNS for b in NOUNS if a != b]
    assert_uniform([(match["target"], match["base"]) for match in matches], pairs)


@pytest.mark.slow
def test_gray_pictures_introduce_target_and_base_once_each(problems: list[Problem]) -> None:
    for problem in problems:
        images = dict(problem.prompt.images)
        assert len(images) == 8
        target, base, _ = roles(problem)
        for name, original in (("dragged_obj", target), ("base_obj", base)):
            image = images[name]
            assert problem.prompt.text.count("{" + name + "}") == 1
            assert isinstance(image, ObjectImage)
            shown = image.placement
            assert (shown.object, shown.texture, shown.scale) == (original.object, "gray", (1, 1, 1))


@pytest.mark.slow
def test_five_bodies_stand_apart_and_only_bases_are_fixed(problems: list[Problem]) -> None:
    base_shapes = pool(TASK, "L4").base_objects
    for problem in problems:
        placements = problem.scene.placements
        assert len(placements) == 5
        assert all(placement.fixed is (placement.object in base_shapes) for placement in placements)
        target, base, twin, others = roles_with_twins(problem)
        assert (twin.object, twin.size) == (target.object, target.size)
        assert not {other.object for other in others} & {base.object, target.object}
        assert all(
            anchor.pose.planar_distance(other.pose) >= 0.1
            for anchor in (target, base)
            for other in (twin, *others)
        )


@pytest.mark.slow
def test_textures_of_distractors_come_from_both_lists_put_together(problems: list[Problem]) -> None:
    drawn_from = pool(TASK, "L4")
    entries = collections.Counter((*drawn_from.dragged_textures, *drawn_from.base_textures))
    assert entries.total() == 91 and collections.Counter(entries.values()) == {1: 53, 2: 19}
    drawn = [d.texture for problem in problems for d in roles_with_twins(problem)[3]]
    assert_frequencies(drawn, {texture: count / 91 for texture, count in entries.items()})


def test_outcomes_change_at_the_limits() -> None:
    for seed in range(25):
        assert_judged_at_its_limits(sample_episode(TASK, level="L4", seed=seed, difficulty="hard").problem)
