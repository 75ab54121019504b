"""Planned sweeps push one block and keep away from all others."""

import math

import pytest

from openvima.env import TabletopEnv
from openvima.scene import InZone, NeverTouches, Placement, Pose, Problem, Prompt, Scene, Zone, ZoneKeptClear
from openvima.tasks import sample_episode
from openvima.tasks.pushes import SHORTFALL_M, STANDOFF_M, Rectangle, Sweep, View
from openvima.tasks.sweeping import plan_sweep, separating_sweeps

ZONE, LINE = Zone(0.5, 0.0, 0.1, 0.27), Zone(0.41, 0.0, 0.04, 0.34)
AREA = Zone(0.39, 0.0, 0.172, 0.3)  # with a line at its mouth
SHORT, LONG = Zone(0.496, 0.0, 0.04, 0.1875), Zone(0.496, 0.0, 0.04, 0.4625)
FAR = (0.6, 0.3)


def problem_with(
    swept: dict[int, tuple[float, float]],
    distractors: dict[int, tuple[float, float]],
    *,
    zone: Zone = ZONE,
    line: Zone = LINE,
    yaw_rad: float = 0.0,
) -> Problem:
    blocks = tuple(
        Placement(object_id, "small block", "red", (0.03, 0.03, 0.03), Pose.planar(x, y, yaw_rad, z=0.014))
        for object_id, (x, y) in sorted((swept | distractors).items())
    )
    goals = tuple(InZone(object_id, zone) for object_id in swept)
    never = NeverTouches(tuple(swept), line, "line")
    clear = ZoneKeptClear(tuple(distractors), zone)
    return Problem(Scene(blocks, "spatula"), Prompt("", ()), goals, (never, clear))


def plan(problem: Problem, *, open_ids: tuple[int, ...] | None = None, compat: bool = False) -> Sweep:
    goals = [
        g for g in problem.goals if isinstance(g, InZone) and (open_ids is None or g.object_id in open_ids)
    ]
    return plan_sweep(goals, problem.scene, problem, compat=compat)


def way(sweep: Sweep) -> tuple[float, float, float]:
    """Direction and length of a sweep."""
    dx, dy = sweep.end[0] - sweep.start[0], sweep.end[1] - sweep.start[1]
    length = math.hypot(dx, dy)
    return dx / length, dy / length, length


def pushed_to(sweep: Sweep) -> tuple[float, float]:
    dx, dy, _ = way(sweep)
    return sweep.end[0] - SHORTFALL_M * dx, sweep.end[1] - SHORTFALL_M * dy


def passed_over(
    sweep: Sweep, start: tuple[float, float], back: float, front: float, half_width: float
) -> Rectangle:
    """A rectangle along a sweep from so far behind a point to so far ahead of it."""
    dx, dy, _ = way(sweep)
    middle = (back + front) / 2
    x, y = start[0] + middle * dx, start[1] + middle * dy
    return Rectangle(x, y, math.atan2(dy, dx), (front - back) / 2, half_width)


def covered(sweep: Sweep) -> Rectangle:
    """What the spatula passes over, and a block in front of its middle, without any margin."""
    return passed_over(sweep, sweep.start, -0.0225, way(sweep)[2] - SHORTFALL_M + 0.015, 0.025)


def meets_others(problem: Problem, sweep: Sweep) -> bool:
    others = [p for p in problem.scene.placements if not p.fixed and p.id != sweep.goal.object_id]
    return any(covered(sweep).comes_near(Rectangle.of_box(p.pose, 0.03, 0.03)) for p in others)


def block_meets(problem: Problem, sweep: Sweep, line: Zone) -> bool:
    """Whether the block that is swept passes over the line."""
    pose = problem.scene[sweep.goal.object_id].pose
    front = way(sweep)[2] - STANDOFF_M - SHORTFALL_M
    block = passed_over(sweep, (pose.x, pose.y), -0.0212, front + 0.0212, 0.0212)
    return block.comes_near(Rectangle.of_zone(line))


def is_inside(place: tuple[float, float]) -> bool:
    """Whether a block pushed there lies well inside the area."""
    return abs(place[0] - AREA.x) < AREA.size_x / 2 - 0.02 and abs(place[1]) < AREA.size_y / 2 - 0.02


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
    assert sweep.goal.object_id == 5 and not meets_others(problem, sweep)


def test_the_next_block_stops_beside_the_one_swept_before() -> None:
    problem = problem_with({4: (0.5, 0.0), 5: (0.65, -0.1)}, {})
    sweep = plan(problem, open_ids=(5,))
    x, y = pushed_to(sweep)
    assert x == pytest.approx(ZONE.x) and -0.11 < y < -0.04
    assert not meets_others(problem, sweep)


def test_neighbours_too_close_for_the_spatula_are_parted_first() -> None:
    problem = problem_with({4: (0.65, -0.1), 5: (0.65, -0.066)}, {})
    x, y = pushed_to(plan(problem))
    assert x > ZONE.x + ZONE.size_x / 2 + 0.02 or abs(y) > ZONE.size_y / 2 + 0.02  # none goes in


def test_with_a_neighbour_beside_the_spatula_it_comes_down_a_little_aside() -> None:
    problem = problem_with({4: (0.65, 0.0)}, {5: (0.69, 0.04)})
    sweep = plan(problem)
    dx, dy, _ = way(sweep)
    aside_m = dx * (0.0 - sweep.start[1]) - dy * (0.65 - sweep.start[0])
    assert abs(aside_m) == pytest.approx(0.015)
    assert not meets_others(problem, sweep)
    assert sweep.end[0] < ZONE.x


def test_the_spatula_comes_down_clear_of_the_box_around_a_turned_neighbour() -> None:
    # The simulation shifts a block off the spatula's place by the box around it, seen from the spatula.
    problem = problem_with({4: (0.6938, 0.0596), 5: (0.7478, 0.0365)}, {}, yaw_rad=math.radians(72))
    sweep = plan(problem)
    other = {4: 5, 5: 4}[sweep.goal.object_id]
    spatula = passed_over(sweep, sweep.start, -0.0225, -0.0175, 0.025)
    assert not spatula.meets_box_around(Rectangle.of_box(problem.scene[other].pose, 0.03, 0.03))


@pytest.mark.parametrize(("y", "side"), [(0.15, 1), (-0.18, -1)])
def test_a_block_beside_a_short_line_goes_through_the_gap(y: float, side: int) -> None:
    problem = problem_with({4: (0.65, y)}, {}, zone=AREA, line=SHORT)
    sweep = plan(problem)
    assert not block_meets(problem, sweep, SHORT)
    assert is_inside(pushed_to(sweep)) and side * pushed_to(sweep)[1] > 0


@pytest.mark.parametrize("line", [SHORT, LONG])
@pytest.mark.parametrize("y", [0.05, -0.1])
def test_a_block_in_front_of_a_line_stops_beside_it_first(line: Zone, y: float) -> None:
    problem = problem_with({4: (0.62, y)}, {}, zone=AREA, line=line)
    first = plan(problem)
    stop = pushed_to(first)
    assert not block_meets(problem, first, line)
    assert stop[1] * y > 0 and abs(stop[1]) > line.size_y / 2
    moved = problem_with({4: stop}, {}, zone=AREA, line=line)
    second = plan(moved)
    assert not block_meets(moved, second, line)
    assert is_inside(pushed_to(second))


def test_a_detour_goes_around_the_other_end_if_distractors_fence_the_near_one_off() -> None:
    fence = {5 + i: (0.47 + 0.031 * i, 0.16) for i in range(9)}
    problem = problem_with({4: (0.62, 0.01)}, fence, zone=AREA, line=SHORT)
    sweep = plan(problem)
    assert pushed_to(sweep)[1] < 0 and not block_meets(problem, sweep, SHORT)


@pytest.mark.parametrize("difficulty", ["easy", "medium", "hard"])
def test_first_sweeps_around_a_line_touch_nothing(difficulty: str) -> None:
    num_clear = 0
    for seed in range(60):
        problem = sample_episode(
            "sweep_without_touching", level="L4", seed=seed, difficulty=difficulty
        ).problem
        line = problem.constraints[0]
        assert isinstance(line, NeverTouches)
        sweep = plan(problem)
        assert not block_meets(problem, sweep, line.zone)
        num_clear += not meets_others(problem, sweep)
    assert num_clear >= 58


def test_a_group_is_parted_without_pushing_a_block_along_the_edge() -> None:
    problem = problem_with({4: (0.713, 0.107), 5: (0.748, 0.113)}, {})
    goals = [goal for goal in problem.goals if isinstance(goal, InZone)]
    parting = next(separating_sweeps(View.build(goals, problem.scene, problem)))
    assert parting.goal.object_id == 5
    inwards = problem_with({4: (0.643, 0.107), 5: (0.678, 0.113)}, {})
    assert next(separating_sweeps(View.build(goals, inwards.scene, inwards))).goal.object_id == 4


def test_sweeps_of_blocks_at_the_edge_start_within_reach_of_an_action() -> None:
    for y in (-0.2, -0.1, 0.0, 0.1, 0.2):
        for line in (SHORT, LONG):
            sweep = plan(problem_with({4: (0.749, y)}, {5: (0.749, y + 0.045)}, zone=AREA, line=line))
            assert sweep.start[0] <= 0.756 and sweep.end[0] <= 0.75


@pytest.mark.parametrize(("level", "seed"), [("train", 449), ("L1", 94), ("L2", 790)])
def test_tight_groups_at_the_edge_stay_on_the_table(level: str, seed: int) -> None:
    env = TabletopEnv("sweep_without_exceeding", level=level, domain="eval")
    env.reset(seed=seed)
    while not env.outcome.is_over:
        env.step(env.oracle_decision().action)
    assert env.outcome.success, env.outcome.reason


def test_compat_takes_the_first_block_and_does_not_look() -> None:
    sweep = plan(problem_with({4: (0.72, 0.1), 5: (0.62, 0.05)}, {6: (0.66, 0.07)}), compat=True)
    assert (sweep.goal.object_id, sweep.start, sweep.end) == (4, (0.72, 0.1), (ZONE.x, ZONE.y))


def test_a_block_at_its_target_already_is_still_a_sweep() -> None:
    sweep = plan(problem_with({4: (ZONE.x, ZONE.y)}, {}))
    assert all(math.isfinite(v) for v in (*sweep.start, *sweep.end)) and sweep.start != sweep.end


def test_first_sweeps_touch_nothing_else_and_are_mostly_straight() -> None:
    num_straight, num_clear = 0, 0
    for seed in range(100):
        problem = sample_episode("sweep_without_exceeding", seed=seed).problem
        sweep = plan(problem)
        num_clear += not meets_others(problem, sweep)
        num_straight += abs(pushed_to(sweep)[1]) < 1e-9
    assert num_straight >= 90
    assert num_clear >= 97
