"""Area, line, zone and success of `sweep_without_touching` follow its specification."""

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.scene import InZone, NeverTouches, Outcome, Pose, Problem, ZoneKeptClear
from openvima.tasks import advance, begin, monitor, sample_episode

LENGTHS = {"easy": 0.1875, "medium": 0.3375, "hard": 0.4625}
Z = 0.014  # m, height of a block's centre on the table
IN_ZONE = (0.39, 0.0)


def problem_with(num_required: int, *, num_swept: int = 3, difficulty: str = "easy") -> Problem:
    for seed in range(1000):
        problem = sample_episode(
            "sweep_without_touching", level="L4", seed=seed, difficulty=difficulty
        ).problem
        if (problem.num_required, len(problem.goals)) == (num_required, num_swept):
            return problem
    raise AssertionError("no such problem")


def groups(problem: Problem) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Ids of the blocks to sweep, and of the distractors."""
    touches, clear = problem.constraints
    assert isinstance(touches, NeverTouches) and isinstance(clear, ZoneKeptClear)
    return touches.object_ids, clear.object_ids


def judged(problem: Problem, places: dict[int, tuple[float, float]]) -> Outcome:
    """Outcome of one step that puts blocks, their sides along the axes, to these places."""
    poses = {object_id: Pose.planar(x, y, z=Z) for object_id, (x, y) in places.items()}
    return advance(problem, begin(problem), problem.scene.with_poses(poses))[1]


@pytest.mark.parametrize("difficulty", LENGTHS)
def test_bounds_line_and_zones_have_the_published_sizes(difficulty: str) -> None:
    for seed in range(20):
        episode = sample_episode("sweep_without_touching", level="L4", seed=seed, difficulty=difficulty)
        problem = episode.problem
        line, bounds = sorted((p for p in problem.scene.placements if p.fixed), key=lambda p: p.object)
        assert (line.object, bounds.object) == ("line", "three-sided rectangle")
        assert bounds.size[:2] == pytest.approx((0.172, 0.3))
        assert line.size[:2] == pytest.approx((LENGTHS[difficulty], 0.04))
        assert bounds.pose.position[:2] == (0.39, 0.0) and line.pose.position[:2] == (0.496, 0.0)
        assert bounds.pose.yaw_rad == pytest.approx(-np.pi / 2) == line.pose.yaw_rad
        goal, (touches, clear) = problem.goals[0], problem.constraints
        assert isinstance(goal, InZone)
        assert isinstance(touches, NeverTouches) and isinstance(clear, ZoneKeptClear)
        assert (goal.zone.x, goal.zone.y, goal.zone.size_x, goal.zone.size_y) == pytest.approx(
            (0.39, 0.0, 0.172, 0.3)
        )
        assert clear.zone == goal.zone
        assert (touches.zone.x, touches.zone.y) == (0.496, 0.0)
        assert (touches.zone.size_x, touches.zone.size_y) == pytest.approx((0.04, LENGTHS[difficulty]))
        assert {g.relative_to for g in problem.goals} == {bounds.id}
        assert (episode.oracle_max_steps, episode.max_steps) == (14, 16)


# Points of a block lie 15 mm before its centre and 5 mm behind it: the zone ends at x = 0.304 … 0.476.
@pytest.mark.parametrize(
    ("place", "success"),
    [
        (IN_ZONE, True),
        ((0.3191, 0.0), True),
        ((0.3189, 0.0), False),
        ((0.4709, 0.1), True),
        ((0.39, -0.1349), True),
        ((0.39, -0.1351), False),
        ((0.39, 0.1449), True),
        ((0.39, 0.1451), False),
    ],
)
def test_all_points_of_a_block_have_to_be_in_the_area(place: tuple[float, float], success: bool) -> None:
    problem = problem_with(1)
    outcome = judged(problem, {groups(problem)[0][0]: place})
    assert outcome == (Outcome(True, False, "1 goal is met") if success else Outcome())


@pytest.mark.parametrize(("difficulty", "end"), [("easy", 0.09375), ("medium", 0.16875), ("hard", 0.23125)])
def test_one_point_on_the_line_is_a_failure(difficulty: str, end: float) -> None:
    problem = problem_with(1, difficulty=difficulty)
    block = groups(problem)[0][0]
    touching = [(0.496, 0.0), (0.5309, 0.0), (0.4711, 0.0), (0.496, end + 0.0149), (0.496, -end - 0.0049)]
    free = [(0.5311, 0.0), (0.496, end + 0.0151), (0.496, -end - 0.0051)]
    assert all(judged(problem, {block: place}).failure for place in touching)
    assert not any(judged(problem, {block: place}).failure for place in free)


def test_the_line_must_not_be_touched_on_the_way() -> None:
    problem = problem_with(1)
    block = groups(problem)[0][0]
    crossing = problem.scene.with_poses({block: Pose.planar(0.5, 0.02, z=Z)})
    progress = monitor(problem, begin(problem), crossing)
    _, outcome = advance(problem, progress, problem.scene.with_poses({block: Pose.planar(*IN_ZONE, z=Z)}))
    assert outcome.failure and outcome.reason.endswith("touched the line")


def test_swept_blocks_must_not_touch_the_line_after_they_were_counted() -> None:
    problem = problem_with(2)
    block = groups(problem)[0][0]
    progress, outcome = advance(
        problem, begin(problem), problem.scene.with_poses({block: Pose.planar(*IN_ZONE, z=Z)})
    )
    assert not outcome.is_over
    assert advance(problem, progress, problem.scene.with_poses({block: Pose.planar(0.496, 0.0)}))[1].failure


def test_distractors_may_touch_the_line_but_not_reach_into_the_area() -> None:
    problem = problem_with(1)
    swept, distractors = groups(problem)
    assert judged(problem, {distractors[0]: (0.496, 0.0)}) == Outcome()
    assert judged(problem, {swept[0]: IN_ZONE, distractors[0]: (0.496, 0.0)}).success
    outcome = judged(problem, {swept[0]: IN_ZONE, distractors[0]: (0.39, 0.16)})
    assert outcome.failure and outcome.reason.endswith("is in the goal zone")


@pytest.mark.parametrize("difficulty", LENGTHS)
@pytest.mark.slow
def test_the_oracle_never_touches_the_line(difficulty: str) -> None:
    env = TabletopEnv("sweep_without_touching", level="L4", domain="eval", difficulty=difficulty)
    for seed in range(8):
        env.reset(seed=seed)
        while not env.outcome.is_over:
            env.step(env.oracle_decision().action)
        assert env.outcome.success, (seed, env.outcome.reason)
