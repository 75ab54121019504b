"""Tables, prompts and zones of the two sweeping tasks follow their specification."""

import collections
import functools
import re

import numpy as np
import pytest

from openvima.catalog import TEXTURE_SETS
from openvima.env import TabletopEnv
from openvima.scene import InZone, NeverTouches, ObjectImage, Placement, Problem, ZoneKeptClear, block_points
from openvima.tasks import sample_episode, task_spec
from openvima.tasks.pushes import Rectangle
from task_cases import assert_frequencies, assert_uniform

NUM_EPISODES = 320
EXCEEDING, TOUCHING = "sweep_without_exceeding", "sweep_without_touching"
TASKS = pytest.mark.parametrize("task", [EXCEEDING, TOUCHING])
LEVELS = [(EXCEEDING, "train"), (EXCEEDING, "L1"), (EXCEEDING, "L2"), (TOUCHING, "L4")]
SPREADS = {EXCEEDING: 0.09, TOUCHING: 0.18}  # of distractors, in metres
CORNERS = ((0.57, -0.22), (0.58, 0.03))


def level_of(task: str) -> str:
    return task_spec(task).levels[0]


@functools.cache
def problems_of(task: str) -> list[Problem]:
    return [sample_episode(task, level=level_of(task), seed=seed).problem for seed in range(NUM_EPISODES)]


def blocks(problem: Problem) -> tuple[list[Placement], list[Placement]]:
    """Blocks to sweep, and distractors."""
    touches, clear = problem.constraints
    assert isinstance(touches, NeverTouches) and isinstance(clear, ZoneKeptClear)
    return [problem.scene[i] for i in touches.object_ids], [problem.scene[i] for i in clear.object_ids]


def flat(problem: Problem) -> tuple[Placement, Placement]:
    """Area and line."""
    bounds, line = sorted((p for p in problem.scene.placements if p.fixed), key=lambda p: p.object == "line")
    return bounds, line


def determiner(problem: Problem) -> str:
    pattern = r"Sweep (\w+) \{swept_obj\} into \{bounds\} without (?:exceeding|touching) \{constraint\}\."
    match = re.fullmatch(pattern, problem.prompt.text)
    assert match, problem.prompt.text
    return match.group(1)


@TASKS
@pytest.mark.parametrize(("difficulty", "most"), [("easy", 1), ("medium", 2), ("hard", 3)])
@pytest.mark.slow
def test_difficulty_brings_more_blocks(task: str, difficulty: str, most: int) -> None:
    sampled = [
        sample_episode(task, level=level_of(task), seed=seed, difficulty=difficulty) for seed in range(300)
    ]
    pairs = [blocks(episode.problem) for episode in sampled]
    assert_frequencies([len(swept) for swept, _ in pairs], {n: 0.5 if n == most else 0.25 for n in (1, 2, 3)})
    assert all(len(swept) == len(distractors) for swept, distractors in pairs)


@TASKS
@pytest.mark.parametrize(
    ("num_swept", "words"), [(1, "any one all"), (2, "any one two all"), (3, "any one two three all")]
)
def test_determiners_are_uniform_and_mean_what_they_say(task: str, num_swept: int, words: str) -> None:
    group = [problem for problem in problems_of(task) if len(problem.goals) == num_swept]
    assert_uniform([determiner(problem) for problem in group], words.split())
    meaning = {"any": 1, "one": 1, "two": 2, "three": 3, "all": num_swept}
    assert all(problem.num_required == meaning[determiner(problem)] for problem in group)


@TASKS
def test_blocks_lie_in_opposite_corners(task: str) -> None:
    on_left = []
    for problem in problems_of(task):
        swept, distractors = blocks(problem)
        on_left.append(swept[0].pose.y < 0)
        corners = CORNERS if on_left[-1] else CORNERS[::-1]
        groups = ((swept, corners[0], 0.18), (distractors, corners[1], SPREADS[task]))
        for group, (x, y), spread in groups:
            assert all(x <= b.pose.x <= min(x + spread, 0.75) and y <= b.pose.y <= y + spread for b in group)
    assert_uniform(on_left, (True, False))


@TASKS
def test_a_lone_block_is_anywhere_in_its_corner_at_any_heading(task: str) -> None:
    poses = [blocks(p)[0][0].pose for p in problems_of(task) if len(p.goals) == 1]
    left = [pose for pose in poses if pose.y < 0]
    assert_uniform([int((pose.x - 0.57) / 0.18 * 6) for pose in left], range(6))
    assert_uniform([int((pose.y + 0.22) / 0.18 * 6) for pose in left], range(6))
    assert_uniform([int((pose.yaw_rad / (2 * np.pi) + 0.5) * 8) for pose in poses], range(8))


@TASKS
def test_no_blocks_of_a_group_overlap_and_none_starts_in_the_zone(task: str) -> None:
    for problem in problems_of(task):
        for group in blocks(problem):
            squares = [Rectangle.of_box(b.pose, 0.03, 0.03) for b in group]
            assert not any(a.comes_near(b, 0.001) for i, a in enumerate(squares) for b in squares[:i])
        goal = problem.goals[0]
        assert isinstance(goal, InZone)
        points = [point for group in blocks(problem) for b in group for point in block_points(b.pose)]
        assert not any(goal.zone.contains(point) for point in points)


@TASKS
def test_compat_takes_blocks_as_they_fall(task: str) -> None:
    num_overlaps = 0
    for seed in range(100):
        problem = sample_episode(task, level=level_of(task), seed=seed, compat=True).problem
        squares = [Rectangle.of_box(b.pose, 0.03, 0.03) for group in blocks(problem) for b in group]
        num_overlaps += any(a.comes_near(b) for i, a in enumerate(squares) for b in squares[:i])
    assert num_overlaps > 10


@pytest.mark.parametrize(("task", "level"), LEVELS)
@pytest.mark.slow
def test_textures_of_the_four_roles_follow_the_level(task: str, level: str) -> None:
    of_blocks, of_flat = {"train": ("C1", "C2"), "L1": ("C1", "C2"), "L2": ("C2", "C1")}.get(
        level, ("T_first", "T_second")
    )
    seen = collections.defaultdict(list)
    for seed in range(800):
        problem = sample_episode(task, level=level, seed=seed).problem
        (swept, distractors), (bounds, line) = blocks(problem), flat(problem)
        assert len({b.texture for b in swept}) == 1 == len({b.texture for b in distractors})
        assert swept[0].texture != distractors[0].texture and bounds.texture != line.texture
        for role, placement in enumerate((swept[0], distractors[0], bounds, line)):
            seen[role].append(placement.texture)
    for role, names in enumerate((of_blocks, of_blocks, of_flat, of_flat)):
        assert_uniform(seen[role], TEXTURE_SETS[names])


@TASKS
def test_the_prompt_shows_one_block_seven_times_as_large(task: str) -> None:
    problem = problems_of(task)[0]
    images = dict(problem.prompt.images)
    assert list(images) == ["swept_obj", "bounds", "constraint"]
    fills = [fill for fill in images.values() if isinstance(fill, ObjectImage)]
    assert [fill.magnification for fill in fills] == [7, 1, 1]
    shown = [(fill.placement.object, fill.placement.texture) for fill in fills]
    expected = (blocks(problem)[0][0], *flat(problem))
    assert shown == [(placement.object, placement.texture) for placement in expected]


LENGTHS = {"easy": 0.1875, "medium": 0.3375, "hard": 0.4625}


def assert_laid_out(problem: Problem, sizes: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """Check what holds for both tasks: area and line of these lengths and widths, and the line's own zone."""
    bounds, line = flat(problem)
    assert (line.object, bounds.object) == ("line", "three-sided rectangle")
    for placement, size in zip((bounds, line), sizes, strict=True):
        assert placement.size[:2] == pytest.approx(size)
        assert placement.pose.y == 0.0 and placement.pose.yaw_rad == pytest.approx(-np.pi / 2)
    goal, (touches, clear) = problem.goals[0], problem.constraints
    assert isinstance(goal, InZone)
    assert isinstance(touches, NeverTouches) and isinstance(clear, ZoneKeptClear)
    assert clear.zone == goal.zone
    assert (touches.zone.x, touches.zone.y, touches.name) == (line.pose.x, 0.0, "line")
    assert (touches.zone.size_y, touches.zone.size_x) == pytest.approx(sizes[1])


@pytest.mark.slow
def test_the_area_ends_before_a_line_that_lies_anywhere_in_its_range() -> None:
    line_xs = []
    for problem in problems_of(EXCEEDING):
        assert_laid_out(problem, ((0.27, 0.27), (0.3375, 0.04)))
        bounds, line = flat(problem)
        assert bounds.pose.x == pytest.approx(0.41)
        line_xs.append(line.pose.x)
        zone = problem.goals[0].zone  # type: ignore[union-attr]
        assert zone.x - zone.size_x / 2 == pytest.approx(line.pose.x + 0.035)
        assert zone.x + zone.size_x / 2 == pytest.approx(0.56)
        assert (zone.y, zone.size_y) == (0.0, pytest.approx(0.27))
        assert {g.relative_to for g in problem.goals} == {line.id}
    low, high = 0.3425, 0.437
    assert low <= min(line_xs) < low + 0.0015 and high - 0.0015 < max(line_xs) <= high
    assert_uniform([int((x - low) / (high - low) * 10) for x in line_xs], range(10))


@pytest.mark.parametrize("difficulty", LENGTHS)
def test_a_line_at_the_mouth_grows_with_the_difficulty(difficulty: str) -> None:
    for seed in range(10):
        episode = sample_episode(TOUCHING, level="L4", seed=seed, difficulty=difficulty)
        problem = episode.problem
        assert_laid_out(problem, ((0.172, 0.3), (LENGTHS[difficulty], 0.04)))
        bounds, line = flat(problem)
        assert (bounds.pose.x, line.pose.x) == (0.39, 0.496)
        zone = problem.goals[0].zone  # type: ignore[union-attr]
        assert (zone.x, zone.y, zone.size_x, zone.size_y) == pytest.approx((0.39, 0.0, 0.172, 0.3))
        assert {g.relative_to for g in problem.goals} == {bounds.id}
        assert (episode.oracle_max_steps, episode.max_steps) == (14, 16)


@pytest.mark.parametrize("difficulty", LENGTHS)
@pytest.mark.slow
def test_the_oracle_never_touches_the_line(difficulty: str) -> None:
    env = TabletopEnv(TOUCHING, level="L4", domain="eval", difficulty=difficulty)
    for seed in range(8):
        env.reset(seed=seed)
        while not env.outcome.is_over:
            env.step(env.oracle_decision().action)
        assert env.outcome.success, (seed, env.outcome.reason)
