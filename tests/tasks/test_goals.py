"""Progress and outcome, by scenes laid out by hand on both sides of every limit."""

import math
from dataclasses import replace

import pytest

from openvima.errors import SceneError
from openvima.scene import (
    AtPose,
    DistractorsApart,
    EveryStepCounts,
    InOrder,
    InZone,
    NeverTouches,
    Outcome,
    Placement,
    Pose,
    Problem,
    Prompt,
    Scene,
    Tolerance,
    Zone,
    ZoneKeptClear,
)
from openvima.tasks import Progress, advance, begin, monitor
from openvima.tasks.goals import measure
from task_cases import judge_step, judged

BASE, TARGET, DISTRACTOR, SECOND = 5, 6, 7, 8
BASE_POSE = Pose.planar(0.5, 0.2)


def placed(object_id: int, x: float, y: float, yaw: float = 0.0, *, fixed: bool = False) -> Placement:
    return Placement(object_id, "block", "red", (0.07, 0.07, 0.07), Pose.planar(x, y, yaw), fixed)


def put_problem(**changes: object) -> Problem:
    scene = Scene(
        (placed(BASE, 0.5, 0.2, fixed=True), placed(TARGET, 0.4, -0.2), placed(DISTRACTOR, 0.6, -0.4))
    )
    goal = AtPose(TARGET, BASE_POSE, Tolerance(0.1), relative_to=BASE)
    problem = Problem(scene, Prompt("", ()), (goal,), (DistractorsApart((DISTRACTOR,)),))
    return replace(problem, **changes)


@pytest.mark.parametrize(("distance", "success"), [(0.0, True), (0.099, True), (0.101, False)])
def test_the_object_has_to_be_near_the_base(distance: float, success: bool) -> None:
    outcome = judge_step(put_problem(), {TARGET: BASE_POSE.moved(dy=-distance)})
    assert (outcome.success, outcome.failure) == (success, False)


@pytest.mark.parametrize(("distance", "failure"), [(0.099, True), (0.101, False)])
def test_a_distractor_at_the_target_is_a_failure(distance: float, failure: bool) -> None:
    outcome = judge_step(put_problem(), {DISTRACTOR: BASE_POSE.moved(dy=distance)})
    assert outcome.failure is failure
    assert ("distractor object 7 (red block) is within 0.1 m" in outcome.reason) is failure


def test_an_object_on_a_distractor_is_a_failure_even_when_it_is_in_the_base() -> None:
    poses = {TARGET: BASE_POSE.moved(dy=0.09), DISTRACTOR: BASE_POSE.moved(dy=0.12)}
    outcome = judge_step(put_problem(), poses)
    assert (
        outcome.failure
        and outcome.reason == "object 6 (red block) is where distractor object 7 (red block) is"
    )


def test_a_lost_object_is_a_failure_and_the_reason_names_it() -> None:
    outcome = judge_step(put_problem(), {TARGET: Pose.planar(0.76, 0.0)})
    assert outcome == Outcome(failure=True, reason="object 6 (red block) left the workspace")


def test_distractors_may_leave_the_workspace_and_without_any_nothing_can_be_too_near() -> None:
    assert judge_step(put_problem(), {DISTRACTOR: Pose.planar(0.9, 0.0)}) == Outcome()
    problem = put_problem(constraints=(DistractorsApart(()),))
    assert judge_step(problem, {DISTRACTOR: BASE_POSE}) == Outcome()


def rotate_problem(start: Pose, angle_rad: float) -> Problem:
    scene = Scene((replace(placed(TARGET, 0, 0), pose=start), placed(DISTRACTOR, 0.6, 0.4, 0.3)))
    tolerance = Tolerance(0.1, math.radians(15))
    goal = AtPose(TARGET, start.rotated(angle_rad), tolerance, relative_to=TARGET)
    return Problem(scene, Prompt("", ()), (goal,), (DistractorsApart((DISTRACTOR,)),))


@pytest.mark.parametrize(("start_deg", "angle_deg"), [(0, -30), (100, -90), (-130, -150)])
def test_an_object_has_to_be_turned_by_the_angle(start_deg: int, angle_deg: int) -> None:
    start, angle = Pose.planar(0.4, 0.0, math.radians(start_deg)), math.radians(angle_deg)
    problem = rotate_problem(start, angle)
    for error_deg, success in ((0, True), (14.5, True), (-14.5, True), (15.5, False), (-15.5, False)):
        pose = start.rotated(angle + math.radians(error_deg))
        assert judge_step(problem, {TARGET: pose}).success is success, error_deg
    assert judge_step(problem, {TARGET: start.rotated(angle).moved(dx=0.099)}).success
    assert judge_step(problem, {TARGET: start.rotated(angle).moved(dx=0.101)}) == Outcome()
    assert judge_step(problem, {TARGET: start.rotated(-angle)}) == Outcome()


@pytest.mark.parametrize(("yaw_off_deg", "failure"), [(0, True), (14, True), (20, False)])
def test_a_turned_object_matches_a_distractor_only_with_its_heading(
    yaw_off_deg: float, failure: bool
) -> None:
    problem = rotate_problem(Pose.planar(0.4, 0.0), -1.0)
    pose = Pose.planar(0.6, 0.35, 0.3 + math.radians(yaw_off_deg))
    assert judge_step(problem, {TARGET: pose}).failure is failure


def two_goals(**changes: object) -> Problem:
    scene = Scene((placed(BASE, 0.5, 0.2, fixed=True), placed(TARGET, 0.4, -0.2), placed(SECOND, 0.6, -0.2)))
    goals = tuple(AtPose(object_id, BASE_POSE, Tolerance(0.1)) for object_id in (TARGET, SECOND))
    return replace(Problem(scene, Prompt("", ()), goals), **changes)


def test_in_sequence_only_the_first_open_goal_counts_in_a_step() -> None:
    both = {TARGET: BASE_POSE, SECOND: BASE_POSE}
    assert judge_step(two_goals(), both).success
    problem = two_goals(stages=(1, 1))
    assert judged(problem, both) == (Progress((1,)), Outcome())
    assert judged(problem, both, {})[1].success
    assert judged(problem, {SECOND: BASE_POSE})[0].open_goals == (0, 1)


def test_a_goal_once_met_stays_met_and_its_object_may_leave() -> None:
    away = {TARGET: Pose.planar(0.9, 0.0), SECOND: BASE_POSE}
    progress, outcome = judged(two_goals(), {TARGET: BASE_POSE}, away)
    assert progress == Progress(()) and outcome.success


def test_objects_of_all_open_goals_must_stay() -> None:
    lost_second = {SECOND: Pose.planar(0.9, 0.0)}
    assert judge_step(two_goals(stages=(1, 1)), lost_second).failure
    assert judge_step(two_goals(), lost_second).failure


def test_the_goals_of_a_later_stage_are_tested_from_the_next_step_on() -> None:
    back = (AtPose(TARGET, Pose.planar(0.4, -0.2), Tolerance(0.1)), AtPose(SECOND, BASE_POSE, Tolerance(0.1)))
    problem = two_goals(goals=(*two_goals().goals, *back), stages=(2, 2))
    assert judged(problem, {TARGET: BASE_POSE})[0].open_goals == (1, 2, 3)
    steps = ({TARGET: BASE_POSE}, {TARGET: Pose.planar(0.4, -0.2), SECOND: BASE_POSE})
    assert judged(problem, *steps) == (Progress((2, 3)), Outcome())
    assert judged(problem, *steps, {})[1].success


def test_stages_have_to_add_up() -> None:
    with pytest.raises(SceneError, match=r"stages \(1, 2\) must add up to the number of goals, 2"):
        two_goals(stages=(1, 2))


def test_distractors_tested_at_the_end_may_be_anywhere_before() -> None:
    problem = two_goals(
        scene=Scene((*two_goals().scene.placements, placed(9, 0.6, 0.4))),
        constraints=(DistractorsApart((9,), at_end=True),),
    )
    first = {9: BASE_POSE, TARGET: BASE_POSE}
    assert judged(problem, first) == (Progress((1,)), Outcome())
    assert judged(problem, first, {SECOND: BASE_POSE})[1].failure
    assert judged(problem, first, {SECOND: BASE_POSE, 9: Pose.planar(0.6, 0.4)})[1].success


def test_a_goal_that_has_to_wait_must_not_come_first() -> None:
    problem = two_goals(constraints=(InOrder((1,)),))
    outcome = judge_step(problem, {SECOND: BASE_POSE})
    assert outcome.failure
    assert outcome.reason == "object 8 (red block) came before object 6 (red block)"
    assert judge_step(problem, {TARGET: BASE_POSE}) == Outcome()
    assert judge_step(problem, {TARGET: BASE_POSE, SECOND: BASE_POSE}).success


def test_an_object_must_not_skip_a_place() -> None:
    places = [Pose.planar(0.5, y) for y in (-0.3, 0.0, 0.3)]
    goals = tuple(AtPose(TARGET, place, Tolerance(0.05)) for place in places)
    problem = two_goals(goals=goals, stages=(1, 1, 1), constraints=(InOrder((1,)),))
    assert judge_step(problem, {TARGET: places[1].moved(dy=0.049)}).failure
    assert judge_step(problem, {TARGET: places[1].moved(dy=0.051)}) == Outcome()
    assert judge_step(problem, {TARGET: places[2]}) == Outcome()  # the last goal may be visited early
    assert judge_step(problem, {TARGET: places[0]}) == Outcome()


def test_where_every_step_counts_the_first_idle_one_is_a_failure() -> None:
    problem = two_goals(stages=(1, 1), constraints=(EveryStepCounts(),))
    idle = judge_step(problem, {SECOND: BASE_POSE})
    assert idle.failure and idle.reason == (
        "the step did not bring object 6 (red block) to where it had to go next"
    )
    first = {TARGET: BASE_POSE}
    assert judge_step(problem, first) == Outcome()
    assert judged(problem, first, {})[1].failure
    assert judged(problem, first, {SECOND: BASE_POSE})[1].success


ZONE, LINE = Zone(0.5, 0.0, 0.1, 0.27), Zone(0.41, 0.0, 0.04, 0.34)
FRONT = {4: (0.65, -0.1), 5: (0.65, 0.0), 6: (0.65, 0.1), 7: (0.7, 0.1)}


def sweep_problem(num_required: int) -> Problem:
    blocks = tuple(
        Placement(object_id, "small block", "red", (0.03, 0.03, 0.03), Pose.planar(x, y, z=0.014))
        for object_id, (x, y) in FRONT.items()
    )
    return Problem(
        Scene(blocks, "spatula"),
        Prompt("", ()),
        tuple(InZone(object_id, ZONE) for object_id in (4, 5, 6)),
        (NeverTouches((4, 5, 6), LINE, "line"), ZoneKeptClear((7,), ZONE)),
        num_required=num_required,
    )


def in_zone(*object_ids: int) -> dict[int, Pose]:
    return {object_id: Pose.planar(0.5, 0.05 * (object_id - 5), z=0.014) for object_id in object_ids}


@pytest.mark.parametrize("num_required", [1, 2, 3])
@pytest.mark.parametrize("num_swept", [0, 1, 2, 3])
def test_exactly_the_asked_number_has_to_be_swept(num_required: int, num_swept: int) -> None:
    outcome = judge_step(sweep_problem(num_required), in_zone(*(4, 5, 6)[:num_swept]))
    assert outcome.success is (num_swept == num_required)
    assert outcome.failure is (num_swept > num_required)


def test_swept_blocks_add_up_over_steps_and_stay_counted() -> None:
    out_again = {4: Pose.planar(*FRONT[4]), **in_zone(5)}
    assert judged(sweep_problem(2), in_zone(4), out_again)[1].success
    assert judge_step(sweep_problem(1), in_zone(4, 5)).reason == "2 goals are met instead of 1"


def test_touching_the_line_for_a_moment_is_a_failure_for_good() -> None:
    problem = sweep_problem(1)
    progress = monitor(problem, begin(problem), problem.scene.with_poses({4: Pose.planar(0.42, 0, z=0.014)}))
    assert progress.violation == "object 4 (red small block) touched the line"
    back = problem.scene.with_poses(in_zone(4))
    progress = monitor(problem, progress, back)
    progress, outcome = advance(problem, progress, back)
    assert outcome.failure and outcome.reason == "object 4 (red small block) touched the line"
    counted = judged(sweep_problem(2), in_zone(4), {4: Pose.planar(0.42, 0.0, z=0.014)})[1]
    assert counted.failure  # also once it is in the zone


def test_distractors_may_touch_the_line_but_not_end_in_the_zone() -> None:
    problem = sweep_problem(1)
    assert judge_step(problem, {7: Pose.planar(0.41, 0.0, z=0.014)}) == Outcome()
    outcome = judge_step(problem, {**in_zone(4), 7: Pose.planar(0.5, 0.1, z=0.014)})
    assert outcome.failure and outcome.reason == "distractor object 7 (red small block) is in the goal zone"


@pytest.mark.parametrize(("x", "failure"), [(0.5649, True), (0.5651, False)])
def test_one_point_of_a_distractor_in_the_zone_is_enough(x: float, failure: bool) -> None:
    assert judge_step(sweep_problem(1), {7: Pose.planar(x, 0.0, z=0.014)}).failure is failure


def test_a_lost_block_is_a_failure_unless_it_was_counted() -> None:
    problem = sweep_problem(2)
    lost = {6: Pose.planar(0.76, 0.0)}
    assert judge_step(problem, lost).failure
    assert not judged(problem, in_zone(6), lost)[1].is_over


def test_a_problem_without_goals_ends_by_a_constraint_alone() -> None:
    problem = put_problem(goals=(), constraints=())
    steps = ({TARGET: BASE_POSE}, {TARGET: Pose.planar(2.0, 0.0)})
    assert judged(problem, *steps)[1] == Outcome()
    kept_clear = ZoneKeptClear((TARGET,), Zone(0.5, 0.2, 0.1, 0.1))
    assert judge_step(put_problem(goals=(), constraints=(kept_clear,)), steps[0]).failure


def measured(problem: Problem, poses: dict[int, Pose]) -> tuple[float, ...]:
    return tuple(measure(problem, judged(problem, poses)[0], problem.scene.with_poses(poses)).values())


def test_progress_is_measured_to_the_nearest_open_goal() -> None:
    problem = put_problem()
    assert measured(problem, {}) == pytest.approx((0, math.hypot(0.1, 0.4), 0))
    assert measured(problem, {TARGET: BASE_POSE.moved(dy=0.15)}) == pytest.approx((0, 0.15, 0))
    assert measured(problem, {TARGET: BASE_POSE.moved(dy=0.05)}) == (1, 0, 0)
    turn = rotate_problem(Pose.planar(0.4, 0.0), math.radians(60))
    assert measured(turn, {TARGET: Pose.planar(0.4, 0.1, math.radians(30))}) == pytest.approx(
        (0, 0.1, math.radians(30))
    )


def test_progress_counts_the_required_goals_only() -> None:
    problem = sweep_problem(2)
    met, distance_m, _ = measured(problem, in_zone(4))
    assert met == 0.5 and distance_m > 0
    assert measured(problem, in_zone(4, 5)) == (1, 0, 0)
    assert measured(problem, in_zone(4, 5, 6))[0] == 1


def test_progress_measures_goals_of_the_running_stage() -> None:
    second = AtPose(DISTRACTOR, Pose.planar(0.6, -0.41), Tolerance(0.001))
    problem = put_problem(constraints=())
    problem = replace(problem, goals=(*problem.goals, second), stages=(1, 1))
    assert measured(problem, {})[1] == pytest.approx(math.hypot(0.1, 0.4))
    assert measured(problem, {TARGET: BASE_POSE}) == pytest.approx((0.5, 0.01, 0))


def test_progress_without_goals_or_distances_is_zero_and_infinitely_far() -> None:
    class Anywhere:
        def is_met(self, scene: Scene) -> bool:
            return False

    for goals in ((), (Anywhere(),)):
        met, *distances = measured(put_problem(goals=goals, constraints=()), {})
        assert met == 0 and distances == [math.inf] * 2
