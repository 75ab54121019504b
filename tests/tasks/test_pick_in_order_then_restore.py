"""Scenes, prompts and outcomes of `pick_in_order_then_restore` follow its specification."""

import functools
import itertools
import math

import numpy as np
import pytest

from openvima.catalog import OBJECT_SETS, Assets, pool
from openvima.scene import Action, AtPose, InOrder, ObjectImage, Outcome, Placement, Pose, Problem
from openvima.sim import World
from openvima.tasks import Progress, TableSampler, sample_episode, task_spec
from task_cases import assert_uniform, judged

TASK = "pick_in_order_then_restore"
CELLS = [(x, y) for x in (0.375, 0.625) for y in (-0.25, 0.0, 0.25)]
BARE_TABLE = Action.planar((0.26, -0.49), (0.26, -0.49))

Roles = tuple[Placement, Placement, list[Placement], list[Placement]]


def roles(problem: Problem) -> Roles:
    """Object, the base that it starts in, the bases to visit in order, the other bases."""
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    (object_id,) = {goal.object_id for goal in goals}
    bases = [problem.scene[goal.relative_to] for goal in goals if goal.relative_to is not None]
    assert [goal.target for goal in goals] == [base.pose for base in bases]
    *targets, source = bases
    shown = {object_id, *(base.id for base in bases)}
    others = [p for p in problem.scene.placements if p.id not in shown]
    return problem.scene[object_id], source, targets, others


@functools.cache
def problems(level: str = "train", difficulty: str = "easy", *, num: int = 1000) -> list[Problem]:
    return [
        sample_episode(TASK, level=level, seed=seed, difficulty=difficulty).problem for seed in range(num)
    ]


def cell_of(base: Placement) -> tuple[float, float]:
    return round(base.pose.x, 9), round(base.pose.y, 9)


def after(problem: Problem, *places: Pose) -> tuple[Progress, Outcome]:
    """How the problem stands after steps that bring the object to these places."""
    return judged(problem, *({roles(problem)[0].id: place} for place in places))


@pytest.mark.parametrize(("difficulty", "num_targets"), [("easy", 2), ("medium", 2), ("hard", 3)])
def test_six_bases_stand_in_two_rows(difficulty: str, num_targets: int) -> None:
    for problem in problems(difficulty=difficulty, num=30):
        dragged, source, targets, others = roles(problem)
        bases = [source, *targets, *others]
        assert (len(targets), len(others)) == (num_targets, 5 - num_targets)
        assert sorted(cell_of(base) for base in bases) == CELLS
        assert all(base.fixed and base.pose.quaternion == (0, 0, 0, 1) for base in bases)
        assert not dragged.fixed
        assert len({(base.object, base.size) for base in bases}) == 1
        assert len({base.texture for base in bases}) == 6
        assert problem.stages == (1,) * (num_targets + 1)
        assert problem.constraints == (InOrder(tuple(range(1, num_targets))),)
        assert problem.oracle_max_steps == num_targets + 2


@pytest.mark.slow
def test_source_and_targets_are_drawn_evenly() -> None:
    drawn = []
    for problem in problems():
        _, source, targets, _ = roles(problem)
        drawn.append(tuple(cell_of(base) for base in (source, *targets)))
    assert_uniform(drawn, itertools.permutations(CELLS, 3))


@pytest.mark.parametrize("difficulty", ["easy", "hard"])
def test_the_prompt_shows_object_and_targets_but_not_the_source(difficulty: str) -> None:
    way = " then ".join(f"{{base_obj_{n}}}" for n in range(1, 3 + (difficulty == "hard")))
    for problem in problems(difficulty=difficulty, num=30):
        dragged, _, targets, _ = roles(problem)
        assert problem.prompt.text == (
            f"Put {{dragged_obj}} into {way}. Finally restore it into its original container."
        )
        shown = {
            name: fill.placement for name, fill in problem.prompt.images if isinstance(fill, ObjectImage)
        }
        assert shown == {"dragged_obj": dragged} | {f"base_obj_{n}": t for n, t in enumerate(targets, 1)}


def laid(assets: Assets, base: str, dragged: str) -> Problem:
    """A problem with this base and this object alone in the pool."""
    train = pool(TASK, "train")
    narrow = type(train)((dragged,), (base,), train.dragged_textures, train.base_textures)
    return task_spec(TASK).sample(TableSampler(np.random.default_rng(0), narrow, assets=assets))


@pytest.mark.parametrize("base", ["bowl", "frame", "square", "container", "pallet"])
def test_the_object_lies_in_its_base_and_stays_there(base: str, assets: Assets) -> None:
    for name in (*OBJECT_SETS["D_train"], *OBJECT_SETS["D_novel"]):
        problem = laid(assets, base, name)
        dragged, source, _, _ = roles(problem)
        before = dragged.pose
        assert before.planar_distance(source.pose) < (0.015 if base == "bowl" else 1e-9)
        world = World(problem.scene, assets)
        world.execute(BARE_TABLE)
        now = world.scene[dragged.id].pose
        assert now.planar_distance(before) < 0.001 and abs(now.z - before.z) < 0.004, name
        turned = abs(sum(a * b for a, b in zip(now.quaternion, before.quaternion, strict=True)))
        assert 2 * math.acos(min(1.0, turned)) < math.radians(2), name


def test_there_and_back_in_order_is_a_success() -> None:
    for problem in problems(difficulty="hard", num=30)[:10]:
        _, source, targets, _ = roles(problem)
        way = [target.pose for target in targets]
        assert after(problem, source.pose) == (Progress((0, 1, 2, 3)), Outcome())
        assert after(problem, *way) == (Progress((3,)), Outcome())
        assert after(problem, *way, source.pose)[1].success


@pytest.mark.parametrize("goal_index", [0, 1, 2])
def test_each_place_counts_within_5_cm(goal_index: int) -> None:
    for problem in problems(num=30)[:10]:
        _, source, (one, two), _ = roles(problem)
        places = [one.pose, two.pose, source.pose]
        for distance, is_met in ((0.049, True), (0.051, False)):
            near = places[goal_index].moved(distance * 0.6, distance * 0.8).rotated(2.0)
            progress, _ = after(problem, *places[:goal_index], near)
            assert len(progress.open_goals) == 3 - goal_index - is_met


def test_a_later_target_must_not_be_visited_before_its_turn() -> None:
    problem = problems(difficulty="hard", num=30)[0]
    _, _, (one, two, three), _ = roles(problem)
    for places in ((two,), (three,), (one, three)):
        *before, last = [place.pose for place in places]
        outcome = after(problem, *before, last.moved(dy=0.049))[1]
        assert outcome.failure and "is where it belongs later" in outcome.reason
        assert not after(problem, *before, last.moved(dy=0.051))[1].is_over


def test_other_places_only_cost_a_step() -> None:
    for problem in problems(num=30)[:10]:
        _, source, (one, two), others = roles(problem)
        home, first, second = (base.pose for base in (source, one, two))
        elsewhere = [*(base.pose for base in others), Pose.planar(0.5, 0.125)]
        way = (*elsewhere, home, first, home, first, *elsewhere, second, first, second, *elsewhere)
        assert after(problem, *way)[1] == Outcome()
        assert after(problem, *way, home)[1].success
