"""Scenes, frames and outcomes of `follow_order` follow its specification."""

import numpy as np
import pytest

from openvima.catalog import Assets, pool
from openvima.env import TabletopEnv
from openvima.scene import Placement, Problem, SceneImage
from openvima.tasks import sample_episode
from openvima.tasks.follow_order import all_stackings
from task_cases import assert_uniform, moves, played

TASK = "follow_order"
NUM_EPISODES = 1000
ROW_OF_THREE, ROW_OF_FOUR = (-0.25, 0.0, 0.25), (-0.3, -0.1, 0.1, 0.3)


@pytest.fixture(scope="module")
def problems() -> list[Problem]:
    return [sample_episode(TASK, seed=seed).problem for seed in range(NUM_EPISODES)]


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
    for seed in range(10):
        episode = sample_episode(TASK, seed=seed, difficulty=difficulty)
        slots = " ".join(f"{{frame_{n}}}" for n in range(num_frames))
        assert episode.problem.prompt.text == f"Stack objects in this order {slots}."
        blocks, distractors = roles(episode.problem)
        assert [block.pose.y for block in blocks] == pytest.approx(row) and len(distractors) == 1
        assert len(episode.problem.goals) == num_frames - 1
        assert episode.oracle_max_steps == num_frames + 1


@pytest.mark.slow
def test_each_step_must_bring_its_block_near_the_place_shown(problems: list[Problem]) -> None:
    for problem in problems[:50]:
        blocks, (distractor,) = roles(problem)
        first, last = moves(problem)
        for distance, is_near in ((0.099, True), (0.101, False)):
            beside = [{i: pose.moved(dx=-distance) for i, pose in move.items()} for move in (first, last)]
            outcomes = played(problem, *beside)
            assert outcomes[0].failure is not is_near and outcomes[1].success is is_near
            assert played(problem, first, beside[1])[1].failure is not is_near
        (awaited, target), *_ = first.items()
        assert played(problem, {})[0].failure
        assert played(problem, {distractor.id: target})[0].failure
        for block in blocks:
            assert block.id == awaited or played(problem, {block.id: target})[0].failure
        if last != first and (awaited not in last or last[awaited].planar_distance(target) > 0.1):
            assert played(problem, last)[0].failure
        assert played(problem, first, {})[1].failure


def test_stacks_of_every_shape_hold() -> None:
    env = TabletopEnv(TASK, level="L3", difficulty="hard")
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
    assert shapes == set(pool(TASK, "L3").dragged_objects)
