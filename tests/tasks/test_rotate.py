"""Scenes and prompts of `rotate` follow its specification."""

import math
import re

import pytest

from openvima.errors import ConfigError
from openvima.scene import AtPose, Problem, angle_difference
from openvima.tasks import sample_episode, task_spec
from task_cases import assert_uniform

NUM_EPISODES = 1500


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode("rotate", seed=seed).problem for seed in range(NUM_EPISODES)]


def asked_deg(problem: Problem) -> int:
    match = re.fullmatch(r"Rotate the \{dragged_obj\} (-?\d+) degrees\.", problem.prompt.text)
    assert match, problem.prompt.text
    return int(match.group(1))


def test_the_five_angles_are_equally_frequent(problems: list[Problem]) -> None:
    assert_uniform((asked_deg(problem) for problem in problems), (30, 60, 90, 120, 150))


def test_shapes_and_textures_are_uniform(problems: list[Problem]) -> None:
    drawn_from = task_spec("rotate").pool("train")
    targets = [problem.scene[problem.goals[0].object_id] for problem in problems]
    assert_uniform((target.object for target in targets), drawn_from.dragged_objects)
    assert_uniform((target.texture for target in targets), drawn_from.dragged_textures)


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
    for seed in range(20):
        scene = sample_episode("rotate", seed=seed, difficulty=difficulty).problem.scene
        assert len(scene.placements) == num_objects


def test_an_explicit_number_of_distractors_wins() -> None:
    scene = sample_episode("rotate", seed=0, difficulty="hard", num_distractors=0).problem.scene
    assert len(scene.placements) == 1


def test_other_angles_can_be_asked_for() -> None:
    assert {
        asked_deg(sample_episode("rotate", seed=s, angles_deg=(-45, 200)).problem) for s in range(20)
    } == {-45, 200}


@pytest.mark.parametrize("angles_deg", [(15,), (30, 0), (360,), (-350,), ()])
def test_angles_within_the_tolerance_are_refused(angles_deg: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match="must be larger than 15 degrees"):
        sample_episode("rotate", seed=0, angles_deg=angles_deg)


@pytest.mark.parametrize("angles_deg", [(math.nan,), (60, math.inf), 60, ("60",)])
def test_angles_have_to_be_numbers(angles_deg: object) -> None:
    with pytest.raises(ConfigError, match="angles_deg"):
        sample_episode("rotate", seed=0, angles_deg=angles_deg)


@pytest.mark.parametrize("num_distractors", [-1, 7, 1.0])
def test_bad_numbers_of_distractors_are_refused(num_distractors: object) -> None:
    with pytest.raises(ConfigError, match="num_distractors is"):
        sample_episode("rotate", seed=0, num_distractors=num_distractors)


def test_no_shape_of_the_pool_has_a_rotational_symmetry() -> None:
    from openvima.catalog import object_spec

    for pool in task_spec("rotate").pools.values():
        assert all(object_spec(name).symmetry_rad == 2 * math.pi for name in pool.dragged_objects)
