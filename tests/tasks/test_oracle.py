"""The oracle's picks lie inside what they pick, and its places follow from them."""

import math

import numpy as np
import pytest

from openvima.catalog import Assets
from openvima.errors import OracleError
from openvima.render.labels import label_raster
from openvima.scene import Action, AtPose, Placement, Pose, Problem, Scene, angle_difference
from openvima.scene.action import pose_after
from openvima.tasks import Progress, begin, make_rng, oracle_action, sample_episode
from openvima.tasks.oracle import visible_point
from task_cases import REPRESENTATIVE_TASKS

RNG = np.random.default_rng(0)


def decide(problem: Problem, assets: Assets, *, compat: bool = False, rng: np.random.Generator = RNG):
    return oracle_action(problem, begin(problem), problem.scene, assets=assets, rng=rng, compat=compat)


def cell(point: tuple[float, float]) -> tuple[int, int]:
    return math.floor((point[1] + 0.5) / 0.003125), math.floor((point[0] - 0.25) / 0.003125)


@pytest.mark.parametrize("task", ["visual_manipulation", "rotate"])
def test_picks_lie_well_inside_the_visible_object(task: str, assets: Assets) -> None:
    for seed in range(30):
        problem = sample_episode(task, seed=seed).problem
        decision = decide(problem, assets)
        labels = label_raster(problem.scene, assets)
        row, column = cell(decision.action.pose0_position)
        assert (labels[row - 1 : row + 2, column - 1 : column + 2] == decision.pick_id).all()


def stack(lower: str, height_m: float, x: float, y: float, z: float) -> Scene:
    """A block above another object, which stands at (0.5, 0)."""
    below = Placement(5, lower, "red", (0.07, 0.07, height_m), Pose.planar(0.5, 0.0, z=height_m / 2 - 0.001))
    return Scene((below, Placement(6, "block", "red", (0.07, 0.07, 0.07), Pose.planar(x, y, z=z))))


def test_the_pick_is_the_cell_farthest_from_the_outline_of_what_is_not_covered(assets: Assets) -> None:
    beside = stack("block", 0.07, 0.7, 0.0, 0.034)
    assert visible_point(beside, 5, assets=assets) == pytest.approx((0.5, 0.0), abs=0.0032)
    x, y = visible_point(stack("block", 0.07, 0.52, 0.0, 0.104), 5, assets=assets)
    assert 0.465 < x < 0.485 and abs(y) < 0.03
    with pytest.raises(OracleError, match=r"object 5 \(red shorter block\) is not visible"):
        visible_point(stack("shorter block", 0.03, 0.5, 0.0, 0.064), 5, assets=assets)


@pytest.mark.parametrize("task", REPRESENTATIVE_TASKS)
@pytest.mark.parametrize("compat", [False, True])
def test_decisions_draw_nothing_but_with_compat_and_stay_within_their_bounds(
    task: str, compat: bool, assets: Assets
) -> None:
    for seed in range(4):
        problem = sample_episode(task, seed=seed, compat=compat).problem
        rngs = [make_rng("user", task, "train", number, "oracle") for number in (1, 2)]
        state = rngs[0].bit_generator.state
        first, second = (decide(problem, assets, compat=compat, rng=rng) for rng in rngs)
        assert compat or (first == second and rngs[0].bit_generator.state == state)
        action = first.action
        assert Action.from_arrays(action.to_arrays()) == action
        assert action.pose0_rotation == (0, 0, 0, 1) and action.pose1_rotation[3] >= 0


@pytest.mark.parametrize("task", ["visual_manipulation", "rotate"])
@pytest.mark.parametrize("compat", [False, True])
def test_the_action_brings_the_object_to_its_target(task: str, compat: bool, assets: Assets) -> None:
    for seed in range(15):
        problem = sample_episode(task, seed=seed, compat=compat).problem
        (goal,) = problem.goals
        assert isinstance(goal, AtPose)
        start = problem.scene[goal.object_id].pose
        action = decide(problem, assets, compat=compat).action
        reached = pose_after(start, action)
        assert reached.planar_distance(goal.target) < 1e-5
        wanted = start.yaw_rad if task == "visual_manipulation" and not compat else goal.target.yaw_rad
        assert angle_difference(reached.yaw_rad, wanted) < 1e-5


def test_a_place_is_told_relative_to_the_base_the_object_or_the_line(assets: Assets) -> None:
    def anchor(task: str) -> Placement:
        problem = sample_episode(task, seed=2).problem
        decision = decide(problem, assets)
        assert decision.pick_id in {goal.object_id for goal in problem.goals}
        assert (decision.place_id == decision.pick_id) is (task == "rotate")
        return problem.scene[decision.place_id]

    anchor("rotate")
    assert anchor("visual_manipulation").fixed
    assert anchor("sweep_without_exceeding").object == "line"


def test_compat_picks_all_over_the_object(assets: Assets) -> None:
    problem = sample_episode("rotate", seed=0, compat=True).problem
    rng = np.random.default_rng(1)
    picks = {decide(problem, assets, compat=True, rng=rng).action.pose0_position for _ in range(50)}
    assert len(picks) > 40


def test_a_finished_episode_leaves_the_oracle_without_an_action(assets: Assets) -> None:
    problem = sample_episode("rotate", seed=0).problem
    with pytest.raises(OracleError, match="nothing left to do"):
        oracle_action(problem, Progress(()), problem.scene, assets=assets, rng=RNG)
