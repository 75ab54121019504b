"""Scenes and prompts of `rotate` follow its specification."""

import math
import re

import pytest

from openvima.scene import AtPose, Problem, angle_difference
from openvima.tasks import sample_episode, task_spec
from task_cases import assert_uniform

NUM_EPISODES = 500


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode("rotate", seed=seed).problem for seed in range(NUM_EPISODES)]


def asked_deg(problem: Problem) -> int:
    match = re.fullmatch(r"Rotate the \{dragged_obj\} (-?\d+) degrees\.", problem.prompt.text)
    assert match, problem.prompt.text
    return int(match.group(1))


def test_the_five_angles_are_equally_frequent(problems: list[Problem]) -> None:
    assert_uniform((asked_deg(problem) for problem in problems), (30, 60, 90, 120, 150))


def test_the_target_is_the_start_turned_clockwise(problems: list[Problem]) -> None:
    for problem in problems[:100]:
        (goal,) = problem.goals
        assert isinstance(goal, AtPose)
        start = problem.scene[goal.object_id].pose
        assert goal.target.position == start.position
        clockwise = start.yaw_rad - goal.target.yaw_rad
        assert angle_difference(clockwise, math.radians(asked_deg(problem))) < 1e-9
        assert goal.relative_to == goal.object_id
        assert (goal.tolerance.position_m, goal.tolerance.yaw_rad) == (0.1, pytest.approx(math.pi / 12))


def test_a_distractor_may_share_the_shape_but_not_the_texture(problems: list[Problem]) -> None:
    num_same = 0
    for problem in problems:
        (goal,) = problem.goals
        target = problem.scene[goal.object_id]
        (distractor,) = (p for p in problem.scene.placements if p.id != target.id)
        assert distractor.texture != target.texture
        assert distractor.pose.planar_distance(target.pose) >= 0.1
        num_same += distractor.object == target.object
    assert 0.08 < num_same / NUM_EPISODES < 0.18  # 1 in 8


def test_only_letter_r_is_turned_at_l3() -> None:
    shapes = {
        p.object
        for s in range(20)
        for p in sample_episode("rotate", level="L3", seed=s).problem.scene.placements
    }
    assert shapes == {"letter R"}


@pytest.mark.parametrize(("difficulty", "num_objects"), [("easy", 2), ("medium", 4), ("hard", 6)])
def test_difficulty_adds_distractors(difficulty: str, num_objects: int) -> None:
    episodes = (sample_episode("rotate", seed=seed, difficulty=difficulty) for seed in range(5))
    assert {len(episode.problem.scene.placements) for episode in episodes} == {num_objects}


def test_no_shape_of_the_pool_has_a_rotational_symmetry() -> None:
    from openvima.catalog import object_spec

    for pool in task_spec("rotate").pools.values():
        assert all(object_spec(name).symmetry_rad == 2 * math.pi for name in pool.dragged_objects)
