"""Scenes, frames and outcomes of `follow_motion` follow its specification."""

import itertools
import math

import pytest

from openvima.scene import AtPose, ObjectImage, Placement, Pose, Problem, SceneImage
from openvima.tasks import sample_episode
from task_cases import assert_uniform, moves, played

TASK = "follow_motion"
NUM_EPISODES = 1000
POINTS = [
    Pose.planar(0.5 + 0.19 * math.cos(a), 0.19 * math.sin(a)) for a in (n * 0.4 * math.pi for n in range(5))
]


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, seed=seed).problem for seed in range(NUM_EPISODES)]


def roles(problem: Problem) -> tuple[Placement, Placement]:
    """The object to move and the distractor."""
    (moved_id,) = {goal.object_id for goal in problem.goals}
    (distractor,) = (p for p in problem.scene.placements if p.id != moved_id)
    return problem.scene[moved_id], distractor


def frames(problem: Problem) -> list[tuple[Placement, Placement]]:
    """For each frame the object to move and the distractor that is shown instead of the real one."""
    moved, _ = roles(problem)
    shown = []
    for _, fill in problem.prompt.images[1:]:
        assert isinstance(fill, SceneImage)
        one, other = fill.scene.placements
        follows = (one.object, one.texture) == (moved.object, moved.texture)
        shown.append((one, other) if follows else (other, one))
    return shown


def targets(problem: Problem) -> list[Pose]:
    return [goal.target for goal in problem.goals if isinstance(goal, AtPose)]


def point_of(pose: Pose) -> int:
    (index,) = (n for n, point in enumerate(POINTS) if pose.planar_distance(point) < 1e-9)
    return index


@pytest.mark.slow
def test_walks_are_uniform(problems: list[Problem]) -> None:
    walks = []
    for problem in problems:
        points = [point_of(pose) for pose in (roles(problem)[0].pose, *targets(problem))]
        walks.append((points[0], *((after - before) % 5 for before, after in itertools.pairwise(points))))
    assert_uniform(walks, [(start, a, b) for start in range(5) for a in (1, 4) for b in (1, 4)])


@pytest.mark.slow
def test_the_distractors_of_table_and_frames_are_drawn_apart(problems: list[Problem]) -> None:
    num_alike = num_same_shape = num_same_texture = 0
    for problem in problems:
        moved, distractor = roles(problem)
        shown = frames(problem)[0][1]
        for other in (distractor, shown):
            assert (other.object, other.texture) != (moved.object, moved.texture)
            num_same_shape += other.object == moved.object
            num_same_texture += other.texture == moved.texture
        num_alike += distractor.object == shown.object
    assert 0.03 < num_alike / NUM_EPISODES < 0.08  # 1 in 19
    assert 0.035 < num_same_shape / NUM_EPISODES / 2 < 0.07  # nearly 1 in 19
    assert 0.01 < num_same_texture / NUM_EPISODES / 2 < 0.03  # nearly 1 in 49


@pytest.mark.slow
def test_the_frames_show_the_start_and_the_target_of_each_move(problems: list[Problem]) -> None:
    for problem in problems[:300]:
        moved, _ = roles(problem)
        (_, picture), *_ = problem.prompt.images
        assert isinstance(picture, ObjectImage) and picture.placement == moved
        shown = frames(problem)
        assert [frame[0].pose for frame in shown] == [moved.pose, *targets(problem)]
        assert {(frame[0].id, frame[0].size) for frame in shown} == {(shown[0][0].id, moved.size)}
        assert {frame[1] for frame in shown} == {shown[0][1]}
        assert (shown[0][1].pose.x, shown[0][1].pose.y) == (0.5, 0.0)
        assert {placement.id for placement in shown[0]} == {2, 3}


@pytest.mark.parametrize(("difficulty", "num_frames"), [("easy", 3), ("medium", 4), ("hard", 5)])
def test_difficulty_adds_frames(difficulty: str, num_frames: int) -> None:
    for seed in range(10):
        episode = sample_episode(TASK, seed=seed, difficulty=difficulty)
        slots = " ".join(f"{{frame_{n}}}" for n in range(num_frames))
        assert episode.problem.prompt.text == f"Follow this motion for {{dragged_obj}}: {slots}."
        assert len(episode.problem.goals) == num_frames - 1 == episode.oracle_max_steps


@pytest.mark.slow
def test_each_step_must_bring_the_object_near_the_next_place(problems: list[Problem]) -> None:
    for problem in problems[:10]:
        moved, distractor = roles(problem)
        first, last = moves(problem)
        for distance, is_near in ((0.099, True), (0.101, False)):
            beside = [{moved.id: place.moved(dy=distance)} for place in targets(problem)]
            outcomes = played(problem, *beside)
            assert outcomes[0].failure is not is_near and outcomes[1].success is is_near
            assert played(problem, first, beside[1])[1].failure is not is_near
        for steps in (
            [{}],
            [{distractor.id: first[moved.id]}],
            [first, {}],
            [first, {distractor.id: last[moved.id]}],
        ):
            assert played(problem, *steps)[-1].failure
        with_it = {distractor.id: first[moved.id]}, {distractor.id: Pose.planar(0.9, 0.0)}
        assert played(problem, first | with_it[0], last | with_it[1])[-1].success


@pytest.mark.slow
def test_the_way_back_has_to_be_walked_too(problems: list[Problem]) -> None:
    back = next(p for p in problems if targets(p)[1].planar_distance(roles(p)[0].pose) < 1e-9)
    assert played(back, {})[0].failure  # it is where it ends, but has not been away
    assert [outcome.success for outcome in played(back, *moves(back))] == [False, True]
