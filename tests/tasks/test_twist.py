"""Scenes, examples and outcomes of `twist` follow its specification."""

import math

import pytest

from openvima.catalog import pool
from openvima.scene import AtPose, DistractorsApart, Placement, Pose, Problem, SceneImage
from openvima.tasks import sample_episode
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


@pytest.mark.slow
def test_angle_texture_and_number_are_uniform(problems: list[Problem]) -> None:
    drawn_from = pool(TASK, "train")
    assert_uniform(map(asked_deg, problems), (30, 60, 90, 120, 150))
    assert_uniform((len(problem.goals) for problem in problems), (1, 2))
    for role in (0, 1):
        first = [roles(problem)[role][0] for problem in problems]
        assert_uniform((p.texture for p in first), drawn_from.dragged_textures)
        assert_uniform((p.object for p in first), drawn_from.dragged_objects)


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
    firsts = []
    for problem in problems:
        targets, _ = roles(problem)
        angle_deg = asked_deg(problem)
        if len({target.object for target in targets}) == 2:
            firsts.append(examples(problem)[0][0].object == targets[0].object)
        for before, after in examples(problem):
            assert clockwise_deg(before.pose, after.pose) == angle_deg
            assert before == after.at(before.pose) and before.pose.position == after.pose.position
            assert before.object in {target.object for target in targets}
            assert before.texture != targets[0].texture
            assert (before.pose.z, before.id) == (0.0, 2)
    assert_uniform(firsts, (True, False))


@pytest.mark.slow
def test_examples_lie_near_the_middle_at_any_heading(problems: list[Problem]) -> None:
    poses = [before.pose for problem in problems[:700] for before, _ in examples(problem)]
    assert_uniform((int((pose.x - 0.4375) // 0.025) for pose in poses), range(5))
    assert_uniform((int((pose.y + 0.375) // 0.15) for pose in poses), range(5))
    assert_uniform((pose.yaw_rad // (math.pi / 4) for pose in poses), range(-4, 4))


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
