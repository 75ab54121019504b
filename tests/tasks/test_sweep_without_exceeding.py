"""Scenes and prompts of `sweep_without_exceeding` follow its specification."""

import collections
import re

import numpy as np
import pytest

from openvima.scene import InZone, NeverTouches, ObjectImage, Placement, Problem, ZoneKeptClear, block_points
from openvima.tasks import sample_episode
from openvima.tasks.footprints import Rectangle

NUM_EPISODES = 1500


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode("sweep_without_exceeding", seed=seed).problem for seed in range(NUM_EPISODES)]


def blocks(problem: Problem) -> tuple[list[Placement], list[Placement]]:
    """Blocks to sweep, and distractors."""
    touches, clear = problem.constraints
    assert isinstance(touches, NeverTouches) and isinstance(clear, ZoneKeptClear)
    return [problem.scene[i] for i in touches.object_ids], [problem.scene[i] for i in clear.object_ids]


def named(problem: Problem, name: str) -> Placement:
    (found,) = (p for p in problem.scene.placements if p.object == name)
    return found


def determiner(problem: Problem) -> str:
    pattern = r"Sweep (\w+) \{swept_obj\} into \{bounds\} without exceeding \{constraint\}\."
    match = re.fullmatch(pattern, problem.prompt.text)
    assert match, problem.prompt.text
    return match.group(1)


def test_one_two_and_three_blocks_come_as_often_as_they_should(problems: list[Problem]) -> None:
    counts = collections.Counter(len(blocks(p)[0]) for p in problems)
    expected = {1: 750, 2: 375, 3: 375}
    assert sum((counts[n] - expected[n]) ** 2 / expected[n] for n in expected) < 13.8  # 2 degrees, p = 0.001
    assert all(len(swept) == len(distractors) for swept, distractors in map(blocks, problems))


@pytest.mark.parametrize(("difficulty", "most"), [("medium", 2), ("hard", 3)])
def test_difficulty_brings_more_blocks(difficulty: str, most: int) -> None:
    sampled = [sample_episode("sweep_without_exceeding", seed=s, difficulty=difficulty) for s in range(200)]
    counts = collections.Counter(len(blocks(e.problem)[0]) for e in sampled)
    assert 70 < counts[most] < 130 and min(counts.values()) > 25


def test_determiners_are_uniform_and_mean_what_they_say(problems: list[Problem]) -> None:
    for num_swept, words in ((1, "any one all"), (2, "any one two all"), (3, "any one two three all")):
        group = [p for p in problems if len(blocks(p)[0]) == num_swept]
        counts = collections.Counter(determiner(p) for p in group)
        assert set(counts) == set(words.split())
        assert min(counts.values()) > 0.6 * len(group) / len(counts)
        meaning = {"any": 1, "one": 1, "two": 2, "three": 3, "all": num_swept}
        assert all(p.num_required == meaning[determiner(p)] for p in group)


def test_bounds_line_and_zones_have_the_published_sizes(problems: list[Problem]) -> None:
    line_xs = []
    for problem in problems:
        bounds, line = named(problem, "three-sided rectangle"), named(problem, "line")
        assert bounds.fixed and line.fixed
        assert bounds.size[:2] == pytest.approx((0.27, 0.27)) and line.size[:2] == pytest.approx(
            (0.3375, 0.04)
        )
        assert (bounds.pose.x, bounds.pose.y, line.pose.y) == (pytest.approx(0.41), 0.0, 0.0)
        assert bounds.pose.yaw_rad == pytest.approx(-np.pi / 2) == line.pose.yaw_rad
        line_xs.append(line.pose.x)
        goal, touches = problem.goals[0], problem.constraints[0]
        assert isinstance(goal, InZone) and isinstance(touches, NeverTouches)
        zone = goal.zone
        assert zone.x - zone.size_x / 2 == pytest.approx(line.pose.x + 0.035)
        assert zone.x + zone.size_x / 2 == pytest.approx(0.56)
        assert (zone.y, zone.size_y) == (0.0, pytest.approx(0.27))
        assert (touches.zone.x, touches.zone.y) == (line.pose.x, 0.0)
        assert (touches.zone.size_x, touches.zone.size_y) == pytest.approx((0.04, 0.3375))
        assert touches.name == "line"
        assert {g.relative_to for g in problem.goals} == {line.id}
    assert 0.3425 <= min(line_xs) < 0.344 and 0.4355 < max(line_xs) <= 0.437


def test_blocks_lie_in_opposite_corners(problems: list[Problem]) -> None:
    corners = ((0.57, -0.22), (0.58, 0.03))
    num_swept_left = 0
    for problem in problems:
        swept, distractors = blocks(problem)
        left = swept[0].pose.y < 0
        num_swept_left += left
        for group, (x, y), spread in (
            (swept, corners[not left], 0.18),
            (distractors, corners[left], 0.09),
        ):
            assert all(x <= b.pose.x <= x + spread and y <= b.pose.y <= y + spread for b in group)
    assert 0.44 < num_swept_left / NUM_EPISODES < 0.56


def test_no_blocks_overlap_and_no_distractor_starts_in_the_zone(problems: list[Problem]) -> None:
    for problem in problems:
        swept, distractors = blocks(problem)
        squares = [Rectangle.of_box(b.pose, 0.03, 0.03) for b in swept + distractors]
        assert not any(a.comes_near(b, 0.001) for i, a in enumerate(squares) for b in squares[:i])
        clear = problem.constraints[1]
        assert isinstance(clear, ZoneKeptClear)
        assert not any(clear.zone.contains(point) for b in distractors for point in block_points(b.pose))


def test_compat_takes_blocks_as_they_fall() -> None:
    num_overlaps = 0
    for seed in range(100):
        problem = sample_episode("sweep_without_exceeding", seed=seed, compat=True).problem
        squares = [Rectangle.of_box(b.pose, 0.03, 0.03) for group in blocks(problem) for b in group]
        num_overlaps += any(a.comes_near(b) for i, a in enumerate(squares) for b in squares[:i])
    assert num_overlaps > 10


def test_textures_of_the_four_roles_follow_the_pool(problems: list[Problem]) -> None:
    from openvima.catalog import TEXTURE_SETS

    for problem in problems:
        swept, distractors = blocks(problem)
        bounds, line = named(problem, "three-sided rectangle"), named(problem, "line")
        assert len({b.texture for b in swept}) == 1 == len({b.texture for b in distractors})
        assert {swept[0].texture, distractors[0].texture} <= set(TEXTURE_SETS["C1"])
        assert {bounds.texture, line.texture} <= set(TEXTURE_SETS["C2"])
        assert swept[0].texture != distractors[0].texture and bounds.texture != line.texture


def test_the_prompt_shows_one_block_seven_times_as_large(problems: list[Problem]) -> None:
    images = dict(problems[0].prompt.images)
    assert list(images) == ["swept_obj", "bounds", "constraint"]
    swept = images["swept_obj"]
    assert isinstance(swept, ObjectImage) and swept.magnification == 7
    assert swept.placement.texture == blocks(problems[0])[0][0].texture
    assert all(isinstance(fill, ObjectImage) and fill.magnification in (1, 7) for fill in images.values())
