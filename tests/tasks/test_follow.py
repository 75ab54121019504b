"""Scenes, frames and outcomes of `follow_motion` and `follow_order` follow their specification."""

import itertools
import math

import numpy as np
import pytest

from openvima.catalog import Assets, pool
from openvima.env import TabletopEnv
from openvima.scene import AtPose, ObjectImage, Placement, Pose, Problem, SceneImage
from openvima.tasks import sample_episode
from openvima.tasks.follow_order import all_stackings
from task_cases import assert_uniform, moves, played

NUM_EPISODES = 1000
ROW_OF_THREE, ROW_OF_FOUR = (-0.25, 0.0, 0.25), (-0.3, -0.1, 0.1, 0.3)


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode("follow_order", seed=seed).problem for seed in range(NUM_EPISODES)]


def roles(problem: Problem) -> tuple[list[Placement], list[Placement]]:
    """The blocks along the row, and the distractors."""
    shown = {(p.object, p.texture) for p in frames(problem)[0]}
    blocks = [p for p in problem.scene.placements if (p.object, p.texture) in shown]
    others = [p for p in problem.scene.placements if (p.object, p.texture) not in shown]
    return sorted(blocks, key=lambda block: block.pose.y), others


def frames(problem: Problem) -> list[tuple[Placement, ...]]:
    fills = [fill for _, fill in problem.prompt.images]
    return [fill.scene.placements for fill in fills if isinstance(fill, SceneImage)]


def stacks(frame: tuple[Placement, ...], row: tuple[float, ...]) -> list[list[str]]:
    """Textures at each place of the row, bottom to top."""
    found = []
    for y in row:
        here = [p for p in frame if (p.pose.x, p.pose.y) == pytest.approx((0.5, y))]
        found.append([p.texture for p in sorted(here, key=lambda p: p.pose.z)])
    assert sum(map(len, found)) == len(frame)
    return found


@pytest.mark.parametrize(
    ("num_blocks", "num_moves", "num_ways"), [(3, 2, 24), (4, 3, 864), (4, 4, 6840), (2, 1, 2)]
)
def test_all_ways_to_stack_are_known(num_blocks: int, num_moves: int, num_ways: int) -> None:
    ways = all_stackings(num_blocks, num_moves)
    assert len(set(ways)) == len(ways) == num_ways
    for way in ways:
        assert way[0] == tuple((block,) for block in range(num_blocks))
        assert all(sorted(sum(step, ())) == list(range(num_blocks)) for step in way)


@pytest.mark.slow
def test_ways_to_stack_are_uniform(problems: list[Problem]) -> None:
    drawn = []
    for problem in problems:
        blocks, _ = roles(problem)
        number = {block.texture: n for n, block in enumerate(blocks)}
        shown = [stacks(frame, ROW_OF_THREE) for frame in frames(problem)]
        drawn.append(tuple(tuple(tuple(number[t] for t in stack) for stack in frame) for frame in shown))
    assert_uniform(drawn, all_stackings(3, 2))


@pytest.mark.slow
def test_blocks_of_one_shape_lie_in_a_row_away_from_the_distractor(
    problems: list[Problem], assets: Assets
) -> None:
    for problem in problems:
        blocks, (distractor,) = roles(problem)
        assert len({block.texture for block in blocks}) == 3
        assert len({(block.object, block.size) for block in blocks}) == 1
        assert distractor.object != blocks[0].object
        assert not any(placement.fixed for placement in problem.scene.placements)
        for block, y in zip(blocks, ROW_OF_THREE, strict=True):
            assert (block.pose.x, block.pose.y) == pytest.approx((0.5, y))
            assert block.pose.quaternion == (0.0, 0.0, 0.0, 1.0)
            assert block.pose.z == assets.geometry(block.object, block.size).rest_z_m
            assert block.pose.planar_distance(distractor.pose) > 0.08
    headings = [roles(problem)[1][0].pose.yaw_rad // (np.pi / 4) for problem in problems]
    assert_uniform(headings, range(-4, 4))


@pytest.mark.slow
def test_the_first_frame_is_the_start_and_the_others_are_what_the_goals_ask_for(
    problems: list[Problem],
) -> None:
    for problem in problems[:300]:
        blocks, _ = roles(problem)
        id_of = {block.texture: block.id for block in blocks}
        poses = {block.id: block.pose for block in blocks}
        for frame, move in zip(frames(problem), [{}, *moves(problem)], strict=True):
            poses |= move
            assert {id_of[p.texture]: p.pose for p in frame} == poses


@pytest.mark.slow
def test_ids_say_nothing_about_the_place(problems: list[Problem]) -> None:
    assert_uniform((roles(problem)[0][0].id for problem in problems), (5, 6, 7, 8))
    first = [min(frames(problem)[0], key=lambda p: p.pose.y).id for problem in problems]
    assert_uniform(first, (2, 3, 4))


@pytest.mark.parametrize(
    ("difficulty", "row", "num_frames"),
    [("easy", ROW_OF_THREE, 3), ("medium", ROW_OF_FOUR, 4), ("hard", ROW_OF_FOUR, 5)],
)
def test_difficulty_adds_blocks_and_frames(difficulty: str, row: tuple[float, ...], num_frames: int) -> None:
    slots = " ".join(f"{{frame_{n}}}" for n in range(num_frames))
    for seed in range(10):
        order, motion = (
            sample_episode(task, seed=seed, difficulty=difficulty)
            for task in ("follow_order", "follow_motion")
        )
        assert order.problem.prompt.text == f"Stack objects in this order {slots}."
        assert motion.problem.prompt.text == f"Follow this motion for {{dragged_obj}}: {slots}."
        blocks, distractors = roles(order.problem)
        assert [block.pose.y for block in blocks] == pytest.approx(row) and len(distractors) == 1
        assert len(order.problem.goals) == len(motion.problem.goals) == num_frames - 1
        assert (order.oracle_max_steps, motion.oracle_max_steps) == (num_frames + 1, num_frames - 1)


def test_stacks_of_every_shape_hold() -> None:
    env = TabletopEnv("follow_order", level="L3", difficulty="hard")
    shapes = set()
    for seed in range(15):
        env.reset(seed=seed)
        while not env.outcome.is_over:
            env.step(env.oracle_decision().action)
        assert env.outcome.success, (seed, env.outcome)
        last = {p.texture: p.pose for p in frames(env.episode.problem)[-1]}
        blocks, _ = roles(env.episode.problem)
        for block in blocks:
            found, shown = env.scene[block.id].pose, last[block.texture]
            assert found.planar_distance(shown) < 1e-3
            assert found.z == pytest.approx(shown.z, abs=7e-3)  # bodies touch 2 mm before they meet
        shapes.add(blocks[0].object)
    assert shapes == set(pool("follow_order", "L3").dragged_objects)


POINTS = [
    Pose.planar(0.5 + 0.19 * math.cos(a), 0.19 * math.sin(a)) for a in (n * 0.4 * math.pi for n in range(5))
]


@pytest.fixture(scope="module")
def motions() -> list[Problem]:
    return [sample_episode("follow_motion", seed=seed).problem for seed in range(NUM_EPISODES)]


def moved_and_other(problem: Problem) -> tuple[Placement, Placement]:
    """The object to move and the distractor."""
    (moved_id,) = {goal.object_id for goal in problem.goals}
    (distractor,) = (p for p in problem.scene.placements if p.id != moved_id)
    return problem.scene[moved_id], distractor


def shown_places(problem: Problem) -> list[tuple[Placement, Placement]]:
    """For each frame the object to move and the distractor that is shown instead of the real one."""
    moved, _ = moved_and_other(problem)
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
def test_walks_are_uniform(motions: list[Problem]) -> None:
    walks = []
    for problem in motions:
        points = [point_of(pose) for pose in (moved_and_other(problem)[0].pose, *targets(problem))]
        walks.append((points[0], *((after - before) % 5 for before, after in itertools.pairwise(points))))
    assert_uniform(walks, [(start, a, b) for start in range(5) for a in (1, 4) for b in (1, 4)])


@pytest.mark.slow
def test_the_distractors_of_table_and_frames_are_drawn_apart(motions: list[Problem]) -> None:
    num_alike = num_same_shape = num_same_texture = 0
    for problem in motions:
        moved, distractor = moved_and_other(problem)
        shown = shown_places(problem)[0][1]
        for other in (distractor, shown):
            assert (other.object, other.texture) != (moved.object, moved.texture)
            num_same_shape += other.object == moved.object
            num_same_texture += other.texture == moved.texture
        num_alike += distractor.object == shown.object
    assert 0.03 < num_alike / NUM_EPISODES < 0.08  # 1 in 19
    assert 0.035 < num_same_shape / NUM_EPISODES / 2 < 0.07  # nearly 1 in 19
    assert 0.01 < num_same_texture / NUM_EPISODES / 2 < 0.03  # nearly 1 in 49


@pytest.mark.slow
def test_the_frames_show_the_start_and_the_target_of_each_move(motions: list[Problem]) -> None:
    for problem in motions[:300]:
        moved, _ = moved_and_other(problem)
        (_, picture), *_ = problem.prompt.images
        assert isinstance(picture, ObjectImage) and picture.placement == moved
        shown = shown_places(problem)
        assert [frame[0].pose for frame in shown] == [moved.pose, *targets(problem)]
        assert {(frame[0].id, frame[0].size) for frame in shown} == {(shown[0][0].id, moved.size)}
        assert {frame[1] for frame in shown} == {shown[0][1]}
        assert (shown[0][1].pose.x, shown[0][1].pose.y) == (0.5, 0.0)
        assert {placement.id for placement in shown[0]} == {2, 3}


@pytest.mark.slow
def test_each_step_must_bring_the_object_near_the_next_place(motions: list[Problem]) -> None:
    for problem in motions[:10]:
        moved, distractor = moved_and_other(problem)
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
def test_the_way_back_has_to_be_walked_too(motions: list[Problem]) -> None:
    back = next(p for p in motions if targets(p)[1].planar_distance(moved_and_other(p)[0].pose) < 1e-9)
    assert played(back, {})[0].failure  # it is where it ends, but has not been away
    assert [outcome.success for outcome in played(back, *moves(back))] == [False, True]
