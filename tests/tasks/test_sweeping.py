"""Planned sweeps push one block and keep away from all others."""

import math

import pytest

from openvima.scene import InZone, NeverTouches, Placement, Pose, Problem, Prompt, Scene, Zone, ZoneKeptClear
from openvima.tasks import sample_episode
from openvima.tasks.footprints import Rectangle
from openvima.tasks.pushes import SHORTFALL_M, STANDOFF_M, Sweep
from openvima.tasks.sweeping import plan_sweep

ZONE = Zone(0.5, 0.0, 0.1, 0.27)
FAR = (0.6, 0.3)


def problem_with(
    swept: dict[int, tuple[float, float]], distractors: dict[int, tuple[float, float]]
) -> Problem:
    blocks = tuple(
        Placement(object_id, "small block", "red", (0.03, 0.03, 0.03), Pose.planar(x, y, z=0.014))
        for object_id, (x, y) in sorted((swept | distractors).items())
    )
    goals = tuple(InZone(object_id, ZONE) for object_id in swept)
    line = NeverTouches(tuple(swept), Zone(0.41, 0, 0.04, 0.34), "line")
    clear = ZoneKeptClear(tuple(distractors), ZONE)
    return Problem(Scene(blocks, "spatula"), Prompt("", ()), goals, (line, clear))


def plan(problem: Problem, *, open_ids: tuple[int, ...] | None = None, compat: bool = False) -> Sweep:
    goals = [
        g for g in problem.goals if isinstance(g, InZone) and (open_ids is None or g.object_id in open_ids)
    ]
    return plan_sweep(goals, problem.scene, problem, compat=compat)


def pushed_to(sweep: Sweep) -> tuple[float, float]:
    dx, dy = sweep.end[0] - sweep.start[0], sweep.end[1] - sweep.start[1]
    length = math.hypot(dx, dy)
    return sweep.end[0] - SHORTFALL_M * dx / length, sweep.end[1] - SHORTFALL_M * dy / length


def covered(sweep: Sweep) -> Rectangle:
    """What blade and block pass over, without any margin."""
    dx, dy = sweep.end[0] - sweep.start[0], sweep.end[1] - sweep.start[1]
    length = math.hypot(dx, dy)
    back, front = -0.0225, length - SHORTFALL_M + 0.015
    middle = (back + front) / 2
    x, y = sweep.start[0] + middle * dx / length, sweep.start[1] + middle * dy / length
    return Rectangle(x, y, math.atan2(dy, dx), (front - back) / 2, 0.025)


def test_a_lone_block_goes_straight_to_the_middle_of_the_zone() -> None:
    sweep = plan(problem_with({4: (0.65, -0.1)}, {5: FAR}))
    assert sweep.goal.object_id == 4
    assert pushed_to(sweep) == pytest.approx((ZONE.x, ZONE.y))
    assert math.hypot(sweep.start[0] - 0.65, sweep.start[1] + 0.1) == pytest.approx(STANDOFF_M)
    assert sweep.start[0] > 0.65 and sweep.start[1] < -0.1  # behind the block


def test_the_nearest_block_goes_first_whatever_its_id() -> None:
    assert plan(problem_with({4: (0.72, -0.15), 5: (0.62, 0.1)}, {})).goal.object_id == 5
    assert plan(problem_with({4: (0.62, 0.1), 5: (0.72, -0.15)}, {})).goal.object_id == 4


def test_a_distractor_in_the_way_makes_another_block_go_first() -> None:
    problem = problem_with({4: (0.65, 0.0), 5: (0.72, -0.15)}, {6: (0.6, 0.01)})
    sweep = plan(problem)
    assert sweep.goal.object_id == 5
    assert not covered(sweep).comes_near(Rectangle(0.6, 0.01, 0.0, 0.015, 0.015))


def test_the_next_block_stops_beside_the_one_swept_before() -> None:
    sweep = plan(problem_with({4: (0.5, 0.0), 5: (0.65, -0.1)}, {}), open_ids=(5,))
    x, y = pushed_to(sweep)
    assert x == pytest.approx(ZONE.x) and -0.11 < y < -0.04
    assert not covered(sweep).comes_near(Rectangle(0.5, 0.0, 0.0, 0.015, 0.015))


def test_neighbours_too_close_for_the_blade_are_parted_first() -> None:
    problem = problem_with({4: (0.65, -0.1), 5: (0.65, -0.066)}, {})
    x, y = pushed_to(plan(problem))
    assert x > ZONE.x + ZONE.size_x / 2 + 0.02 or abs(y) > ZONE.size_y / 2 + 0.02  # none goes in


def test_compat_takes_the_first_block_and_does_not_look() -> None:
    sweep = plan(problem_with({4: (0.72, 0.1), 5: (0.62, 0.05)}, {6: (0.66, 0.07)}), compat=True)
    assert (sweep.goal.object_id, sweep.start, sweep.end) == (4, (0.72, 0.1), (ZONE.x, ZONE.y))


def test_a_block_at_its_target_already_is_still_a_sweep() -> None:
    sweep = plan(problem_with({4: (ZONE.x, ZONE.y)}, {}))
    assert all(math.isfinite(v) for v in (*sweep.start, *sweep.end)) and sweep.start != sweep.end


def test_first_sweeps_touch_nothing_else_and_are_mostly_straight() -> None:
    num_straight, num_clear = 0, 0
    for seed in range(300):
        problem = sample_episode("sweep_without_exceeding", seed=seed).problem
        sweep = plan(problem)
        others = [p for p in problem.scene.placements if not p.fixed and p.id != sweep.goal.object_id]
        ways = covered(sweep)
        num_clear += not any(ways.comes_near(Rectangle.of_box(p.pose, 0.03, 0.03)) for p in others)
        num_straight += abs(pushed_to(sweep)[1]) < 1e-9
    assert num_straight >= 270
    assert num_clear >= 290
