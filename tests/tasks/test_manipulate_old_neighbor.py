"""Scenes, prompts and outcomes of `manipulate_old_neighbor` follow its specification."""

import functools
import math
import re

import pytest

from openvima.catalog import Assets
from openvima.render.labels import label_raster
from openvima.scene import AtPose, DistractorsApart, InOrder, ObjectImage, Outcome, Placement, Pose, Problem
from openvima.tasks import Progress, sample_episode
from task_cases import assert_frequencies, assert_uniform, beside, judge_step, judged

TASK = "manipulate_old_neighbor"
STEPS = {"north": (-1, 0), "south": (1, 0), "west": (0, -1), "east": (0, 1)}  # row, column
FAR_AWAY = Pose.planar(0.9, 0.0)

Roles = tuple[Placement, Placement, Placement, list[Placement]]
Cell = tuple[int, int]


def roles(problem: Problem) -> Roles:
    """Dragged object, old neighbour, base, distractors."""
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    order, apart = problem.constraints
    assert order == InOrder((1,)) and isinstance(apart, DistractorsApart)  # tested in this order
    dragged, neighbour = (problem.scene[goal.object_id] for goal in goals)
    (base_id,) = {goal.relative_to for goal in goals}
    assert base_id is not None
    return dragged, neighbour, problem.scene[base_id], [problem.scene[i] for i in apart.object_ids]


@functools.cache
def problems(level: str = "train", difficulty: str = "easy", *, num: int = 1000) -> list[Problem]:
    return [
        sample_episode(TASK, level=level, seed=seed, difficulty=difficulty).problem for seed in range(num)
    ]


def direction_of(problem: Problem) -> str:
    match = re.fullmatch(
        r"First put \{dragged_obj\} into \{base_obj\} then put the object that was previously at its "
        r"(north|south|west|east) into the same \{base_obj\}\.",
        problem.prompt.text,
    )
    assert match, problem.prompt.text
    return match.group(1)


def cell_of(placement: Placement, num_columns: int = 2) -> Cell:
    row = (placement.pose.x - 0.25) / 0.125 - 1
    column = (placement.pose.y + 0.5) * (num_columns + 2) - 1
    assert math.isclose(row, round(row), abs_tol=1e-9) and math.isclose(column, round(column), abs_tol=1e-9)
    return round(row), round(column)


@pytest.mark.parametrize(
    ("difficulty", "num_columns", "num_empty", "num_distractors"),
    [("easy", 2, 1, 3), ("medium", 3, 3, 4), ("hard", 4, 4, 6)],
)
def test_objects_stand_on_a_grid_beside_the_base_and_the_neighbour_in_the_named_direction(
    difficulty: str, num_columns: int, num_empty: int, num_distractors: int
) -> None:
    for problem in problems(difficulty=difficulty, num=30):
        dragged, neighbour, base, distractors = roles(problem)
        assert len(distractors) == num_distractors == 3 * num_columns - num_empty - 2
        movable = [dragged, neighbour, *distractors]
        assert len({(p.object, p.texture) for p in movable}) == len(movable)
        cells = [cell_of(p, num_columns) for p in movable]
        assert len(set(cells)) == len(cells)
        assert all(row in range(3) and column in range(num_columns) for row, column in cells)
        assert (base.pose.x, base.pose.y) == (0.5, pytest.approx(0.5 - 1 / (num_columns + 2)))
        assert base.fixed and not any(p.fixed for p in movable)
        assert all(p.pose.quaternion == (0, 0, 0, 1) for p in problem.scene.placements)
        (row, column), (down, right) = cells[0], STEPS[direction_of(problem)]
        assert cells[1] == (row + down, column + right)
        shown = {
            name: fill.placement for name, fill in problem.prompt.images if isinstance(fill, ObjectImage)
        }
        assert shown == {"dragged_obj": dragged, "base_obj": base}  # but not the neighbour


@pytest.mark.slow
def test_cells_directions_and_gaps_are_drawn_evenly() -> None:
    cells = [(row, column) for row in range(3) for column in range(2)]
    assert_uniform([cell_of(roles(problem)[0]) for problem in problems()], cells)
    shares: dict[tuple[Cell, str], float] = {}
    for row, column in cells:
        names = [name for name, (down, right) in STEPS.items() if (row + down, column + right) in cells]
        shares |= {((row, column), name): 1 / 6 / len(names) for name in names}
    drawn = [(cell_of(roles(problem)[0]), direction_of(problem)) for problem in problems()]
    assert_frequencies(drawn, shares)
    gaps = []
    for problem in problems():
        dragged, neighbour, _, distractors = roles(problem)
        others = sorted(set(cells) - {cell_of(dragged), cell_of(neighbour)})
        (gap,) = set(others) - {cell_of(p) for p in distractors}
        gaps.append(others.index(gap))
    assert_uniform(gaps, range(4))


@pytest.mark.slow
def test_shapes_and_textures_recur() -> None:
    recurring = {"object": 0, "texture": 0}
    for problem in problems():
        dragged, neighbour, _, distractors = roles(problem)
        for kind in recurring:
            recurring[kind] += len({getattr(p, kind) for p in (dragged, neighbour, *distractors)}) < 5
    # Five looks, drawn independently: 1 − (13 · 12 · 11 · 10) / 14⁴ and 1 − (18 · 17 · 16 · 15) / 19⁴.
    assert recurring["object"] / 1000 == pytest.approx(0.54, abs=0.06)
    assert recurring["texture"] / 1000 == pytest.approx(0.43, abs=0.06)


@pytest.mark.parametrize("level", ["train", "L3"])
def test_nothing_overlaps_and_nothing_is_decided_at_the_start(level: str, assets: Assets) -> None:
    for problem in problems(level, num=15):
        assert judge_step(problem, {}) == Outcome()
        covered = sum((label_raster([p], assets) > 0).astype(int) for p in problem.scene.placements)
        assert covered.max() == 1


def test_object_then_neighbour_is_a_success() -> None:
    for problem in problems(num=10):
        dragged, neighbour, base, _ = roles(problem)
        first = {dragged.id: base.pose}
        for distance, is_met in ((0.099, True), (0.101, False)):
            place = beside(problem, base.pose, distance, moved_id=dragged.id)
            missed = (1,) if is_met else (0, 1)
            assert judged(problem, {dragged.id: place.rotated(1.0)}) == (Progress(missed), Outcome())
            second = {neighbour.id: beside(problem, base.pose, distance, moved_id=neighbour.id)}
            assert judged(problem, first, second)[1].success is is_met
        assert judged(problem, first, {dragged.id: FAR_AWAY, neighbour.id: base.pose})[1].success


def test_the_neighbour_must_not_come_first() -> None:
    problem = problems(num=10)[0]
    dragged, neighbour, base, distractors = roles(problem)
    too_early = {neighbour.id: base.pose}
    outcome = judge_step(problem, too_early)
    assert outcome.failure and "came before" in outcome.reason
    assert judge_step(problem, {**too_early, dragged.id: base.pose}).success  # both at once
    both_wrong = judge_step(problem, {**too_early, distractors[0].id: base.pose})
    assert "came before" in both_wrong.reason  # the order is looked at first
    missed = beside(problem, base.pose, 0.101, moved_id=neighbour.id)
    assert judge_step(problem, {neighbour.id: missed}) == Outcome()  # only a step wasted
