"""Scenes, examples and outcomes of `twist` follow its specification."""

import math
from dataclasses import replace

import numpy as np
import pytest

from openvima.catalog import Assets, Pool, pool
from openvima.errors import ConfigError
from openvima.scene import (
    AtPose,
    DistractorsApart,
    Outcome,
    Placement,
    Pose,
    Problem,
    SceneImage,
    angle_difference,
)
from openvima.tasks import TableSampler, advance, begin, sample_episode, task_spec
from task_cases import assert_frequencies, assert_uniform

TASK = "twist"
NUM_EPISODES = 1000
PROMPT = (
    '"Twist" is defined as rotating object a specific angle. For examples: '
    "From {before_twist_1} to {after_twist_1}. From {before_twist_2} to {after_twist_2}. "
    "From {before_twist_3} to {after_twist_3}. Now twist all TEXTURE objects."
)


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, seed=seed).problem for seed in range(NUM_EPISODES)]


def roles(problem: Problem) -> tuple[list[Placement], list[Placement]]:
    """Objects to turn, and distractors."""
    (constraint,) = problem.constraints
    assert isinstance(constraint, DistractorsApart)
    targets = [problem.scene[goal.object_id] for goal in problem.goals]
    return targets, [problem.scene[i] for i in constraint.object_ids]


def examples(problem: Problem) -> list[tuple[Placement, Placement]]:
    """What each pair of pictures shows, before and after."""
    shown = []
    for name, fill in problem.prompt.images:
        assert isinstance(fill, SceneImage)
        (placement,) = fill.scene.placements
        shown.append((name, placement))
    names = [f"{side}_twist_{n}" for n in range(1, len(shown) // 2 + 1) for side in ("before", "after")]
    assert [name for name, _ in shown] == names
    return [(shown[i][1], shown[i + 1][1]) for i in range(0, len(shown), 2)]


def clockwise_deg(before: Pose, after: Pose) -> int:
    angle_deg = math.degrees(before.yaw_rad - after.yaw_rad) % 360
    assert angle_deg == pytest.approx(round(angle_deg))
    return round(angle_deg)


def asked_deg(problem: Problem) -> int:
    before, after = examples(problem)[0]
    return clockwise_deg(before.pose, after.pose)


def judged(problem: Problem, *moves: dict[int, Pose]) -> Outcome:
    """Outcome after the last of some steps; the first that is over ends the episode."""
    progress, scene, outcome = begin(problem), problem.scene, Outcome()
    for move in moves:
        scene = scene.with_poses(move)
        progress, outcome = advance(problem, progress, scene)
    return outcome


def with_targets(problems: list[Problem], num_targets: int) -> Problem:
    return next(problem for problem in problems if len(problem.goals) == num_targets)


def rotated_clockwise(placement: Placement, problem: Problem, *, off_deg: float = 0.0) -> Pose:
    return placement.pose.rotated(-math.radians(asked_deg(problem) + off_deg))


@pytest.mark.slow
def test_angle_texture_and_number_are_uniform(problems: list[Problem]) -> None:
    drawn_from = pool(TASK, "train")
    assert_uniform(map(asked_deg, problems), (30, 60, 90, 120, 150))
    assert_uniform((len(problem.goals) for problem in problems), (1, 2))
    assert_uniform((roles(problem)[0][0].texture for problem in problems), drawn_from.dragged_textures)
    assert_uniform((roles(problem)[0][0].object for problem in problems), drawn_from.dragged_objects)
    assert_uniform((roles(problem)[1][0].object for problem in problems), drawn_from.dragged_objects)
    assert_uniform((roles(problem)[1][0].texture for problem in problems), drawn_from.dragged_textures)


@pytest.mark.slow
def test_exactly_the_objects_to_turn_have_the_texture_named(problems: list[Problem]) -> None:
    for problem in problems:
        targets, distractors = roles(problem)
        assert len(targets) + len(distractors) == len(problem.scene.placements) == 3
        (texture,) = {target.texture for target in targets}
        assert problem.prompt.text == PROMPT.replace("TEXTURE", texture)
        assert texture not in {distractor.texture for distractor in distractors}


@pytest.mark.slow
def test_distractors_may_look_like_each_other_or_share_the_shape(problems: list[Problem]) -> None:
    shared = [roles(p)[1][0].object == roles(p)[0][0].object for p in problems]
    assert_frequencies(shared, {True: 1 / 8, False: 7 / 8})
    pairs = [roles(p)[1] for p in problems if len(p.goals) == 1]
    assert_frequencies((a.texture == b.texture for a, b in pairs), {True: 1 / 18, False: 17 / 18})


@pytest.mark.slow
def test_every_example_shows_the_angle_on_another_texture(problems: list[Problem]) -> None:
    for problem in problems[:500]:
        targets, _ = roles(problem)
        angle_deg = asked_deg(problem)
        for before, after in examples(problem):
            assert clockwise_deg(before.pose, after.pose) == angle_deg
            assert before == after.at(before.pose) and before.pose.position == after.pose.position
            assert before.object in {target.object for target in targets}
            assert before.texture != targets[0].texture
            assert (before.pose.z, before.id) == (0.0, 2)


@pytest.mark.slow
def test_examples_lie_near_the_middle_at_any_heading(problems: list[Problem]) -> None:
    poses = [before.pose for problem in problems[:700] for before, _ in examples(problem)]
    assert_uniform((int((pose.x - 0.4375) // 0.025) for pose in poses), range(5))
    assert_uniform((int((pose.y + 0.375) // 0.15) for pose in poses), range(5))
    assert_uniform((pose.yaw_rad // (math.pi / 4) for pose in poses), range(-4, 4))


@pytest.mark.slow
def test_the_examples_of_two_shapes_show_both(problems: list[Problem]) -> None:
    firsts = []
    for problem in problems:
        targets, _ = roles(problem)
        if len({target.object for target in targets}) == 2:
            firsts.append(examples(problem)[0][0].object == targets[0].object)
    assert_uniform(firsts, (True, False))


@pytest.mark.slow
def test_the_goals_turn_the_objects_on_the_spot(problems: list[Problem]) -> None:
    for problem in problems[:300]:
        for goal in problem.goals:
            assert isinstance(goal, AtPose)
            start = problem.scene[goal.object_id].pose
            assert goal.target.position == start.position
            assert clockwise_deg(start, goal.target) == asked_deg(problem)
            assert goal.relative_to == goal.object_id and goal.symmetry_rad == 2 * math.pi
            assert (goal.tolerance.position_m, goal.tolerance.yaw_rad) == (0.05, pytest.approx(math.pi / 12))


@pytest.mark.parametrize(("difficulty", "num_objects"), [("easy", 3), ("medium", 4), ("hard", 5)])
@pytest.mark.slow
def test_difficulty_adds_objects(difficulty: str, num_objects: int) -> None:
    numbers = []
    for seed in range(200):
        episode = sample_episode(TASK, seed=seed, difficulty=difficulty)
        assert len(episode.problem.scene.placements) == num_objects
        assert episode.oracle_max_steps == num_objects + 2
        numbers.append(len(episode.problem.goals))
    assert_uniform(numbers, range(1, num_objects))


@pytest.mark.parametrize("task", ["twist", "rotate"])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dragged_objects": ("letter A", "ring", "star")}, "ring, star have a rotational symmetry"),
        ({"dragged_textures": ("red",)}, "distractors need a second one"),
    ],
)
def test_pools_that_cannot_work_are_refused(
    task: str, change: dict[str, tuple[str, ...]], message: str, assets: Assets
) -> None:
    unfit: Pool = replace(pool(task, "train"), **change)
    table = TableSampler(np.random.default_rng(0), unfit, assets=assets)
    with pytest.raises(ConfigError, match=message):
        task_spec(task).sample(table)


@pytest.mark.parametrize("off_deg", [0, 14.5, -14.5, 15.5, -15.5, 180])
@pytest.mark.slow
def test_an_object_has_to_be_turned_by_the_angle_shown(problems: list[Problem], off_deg: float) -> None:
    for problem in [p for p in problems[:60] if len(p.goals) == 1]:
        ((target,), _) = roles(problem)
        outcome = judged(problem, {target.id: rotated_clockwise(target, problem, off_deg=off_deg)})
        assert outcome == (
            Outcome(success=True, reason="all goals are met") if abs(off_deg) < 15 else Outcome()
        )


@pytest.mark.parametrize(("distance", "success"), [(0.049, True), (0.051, False)])
@pytest.mark.slow
def test_an_object_has_to_stay_where_it_was(problems: list[Problem], distance: float, success: bool) -> None:
    problem = with_targets(problems, 1)
    ((target,), _) = roles(problem)
    pose = rotated_clockwise(target, problem).moved(dx=0.6 * distance, dy=-0.8 * distance)
    assert judged(problem, {target.id: pose}) == (
        Outcome(success=True, reason="all goals are met") if success else Outcome()
    )


@pytest.mark.parametrize(("distance", "failure"), [(0.049, True), (0.051, False)])
@pytest.mark.slow
def test_a_distractor_must_not_take_the_place(
    problems: list[Problem], distance: float, failure: bool
) -> None:
    problem = with_targets(problems, 1)
    (target,), (distractor, _) = roles(problem)
    assert judged(problem, {distractor.id: target.pose.moved(dy=distance)}).failure is failure


@pytest.mark.parametrize(("off_deg", "failure"), [(14, True), (16, False)])
@pytest.mark.slow
def test_an_object_must_not_match_a_distractor(
    problems: list[Problem], off_deg: float, failure: bool
) -> None:
    problem = with_targets(problems, 1)
    (target,), (distractor, _) = roles(problem)
    pose = distractor.pose.rotated(math.radians(off_deg)).moved(dx=0.04)
    assert angle_difference(pose.yaw_rad, distractor.pose.yaw_rad) == pytest.approx(math.radians(off_deg))
    assert judged(problem, {target.id: pose}).failure is failure
