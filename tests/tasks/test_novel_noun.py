"""Scenes, prompts and outcomes of `novel_noun` follow its specification."""

import re

import pytest

from openvima.catalog import TEXTURE_SETS, pool
from openvima.scene import ObjectImage, Problem
from openvima.tasks import sample_episode
from task_cases import assert_frequencies, assert_judged_at_its_limits, assert_uniform, roles

TASK = "novel_noun"
NUM_EPISODES = 1000
NOUNS = ("dax", "blicket", "wug", "zup")
FORMS = {
    "target first": r"This is a (?P<target>\w+) \{dragged_obj_1\}\. This is a (?P<base>\w+) \{base_obj\}\. "
    r"Put a (?P=target) into a (?P=base)\.",
    "base first": r"This is a (?P<base>\w+) \{base_obj\}\. This is a (?P<target>\w+) \{dragged_obj_1\}\. "
    r"Put a (?P=target) into a (?P=base)\.",
}


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, seed=seed).problem for seed in range(NUM_EPISODES)]


def matched(problem: Problem) -> tuple[str, re.Match[str]]:
    """Which form the prompt has, and its words."""
    (found,) = [(n, match) for n, form in FORMS.items() if (match := re.fullmatch(form, problem.prompt.text))]
    return found


@pytest.mark.slow
def test_two_different_nouns_are_introduced_in_either_order(problems: list[Problem]) -> None:
    forms, matches = zip(*map(matched, problems), strict=True)
    assert_uniform(forms, FORMS)
    pairs = [(a, b) for a in NOUNS for b in NOUNS if a != b]
    assert_uniform([(match["target"], match["base"]) for match in matches], pairs)


@pytest.mark.slow
def test_the_pictures_are_gray_and_of_target_and_base(problems: list[Problem]) -> None:
    for problem in problems[:200]:
        target, base, _ = roles(problem)
        images = dict(problem.prompt.images)
        assert set(images) == {"dragged_obj_1", "base_obj"}
        for image, shown in ((images["dragged_obj_1"], target), (images["base_obj"], base)):
            assert isinstance(image, ObjectImage)
            assert (image.placement.object, image.placement.size) == (shown.object, shown.size)
            assert image.placement.texture == "gray" and shown.texture != "gray"


@pytest.mark.slow
def test_a_distractor_has_a_third_shape_and_is_fixed_if_a_base(problems: list[Problem]) -> None:
    base_shapes = pool(TASK, "train").base_objects
    num_bases = 0
    for problem in problems:
        target, base, (distractor,) = roles(problem)
        assert distractor.object not in (target.object, base.object)
        assert base.fixed and not target.fixed
        assert distractor.fixed is (distractor.object in base_shapes)
        num_bases += distractor.fixed
    assert 0.13 < num_bases / NUM_EPISODES < 0.21  # 3 of 16 shapes, some of them harder to place


@pytest.mark.parametrize("level", ["train", "L3"])
def test_outcomes_change_at_the_limits(level: str) -> None:
    for seed in range(25):
        assert_judged_at_its_limits(sample_episode(TASK, level=level, seed=seed).problem)


@pytest.mark.parametrize(
    ("difficulty", "options"),
    [
        ("easy", {("C1", "C2"): 1.0}),
        ("medium", {("C1", "C1"): 0.5, ("C2", "C2"): 0.5}),
        ("hard", {("C2", "C1"): 1.0}),
    ],
)
def test_the_difficulty_says_who_gets_which_textures(
    difficulty: str, options: dict[tuple[str, str], float]
) -> None:
    drawn = []
    for seed in range(100):
        target, base, _ = roles(sample_episode(TASK, seed=seed, difficulty=difficulty).problem)
        drawn.append(tuple("C1" if p.texture in TEXTURE_SETS["C1"] else "C2" for p in (target, base)))
    if len(options) == 1:
        assert set(drawn) == set(options)
    else:
        assert_frequencies(drawn, options)


def test_the_number_of_distractors_can_be_chosen() -> None:
    for num_distractors in (0, 2, 3):
        problem = sample_episode(TASK, seed=1, num_distractors=num_distractors).problem
        assert len(roles(problem)[2]) == num_distractors
