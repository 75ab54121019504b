"""Level L5: many objects, and still one reading of each prompt."""

import re

import pytest

from openvima.catalog import object_spec, tasks_at
from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.scene import AtPose, ObjectImage, Placement, Problem
from openvima.tasks import sample_episode
from openvima.tasks.clutter import LEAST, MOST
from task_cases import judge_step, judged

CASES = [(task, seed) for task in tasks_at("L5") for seed in range(4)]
NUM_TWINS = {"novel_adj": {"dragged_obj": 2}}  # of one shape; the adjective tells them apart


def added(problem: Problem) -> list[Placement]:
    """Objects of the clutter: those of the last constraint."""
    return [problem.scene[i] for i in problem.constraints[-1].object_ids]  # type: ignore[union-attr]


@pytest.mark.parametrize(("task", "seed"), CASES)
def test_clutter_is_large_distinct_and_decides_nothing_at_the_start(task: str, seed: int) -> None:
    problem = sample_episode(task, level="L5", seed=seed, domain="eval").problem
    looks = [(p.object, p.texture) for p in added(problem)]
    assert LEAST <= len(looks) <= MOST and len(set(looks)) == len(looks)
    if task != "follow_order":  # there a step has to fulfil a goal
        assert not judge_step(problem, {}).is_over


@pytest.mark.parametrize(("task", "seed"), CASES)
def test_an_image_fits_one_object_on_the_table(task: str, seed: int) -> None:
    problem = sample_episode(task, level="L5", seed=seed, domain="eval").problem
    on_table = [p for p in problem.scene.placements if p.object != "small block"]
    for name, fill in problem.prompt.images:
        if isinstance(fill, ObjectImage) and not name.startswith(("demo_", "swept")):
            shown = fill.placement
            fitting = [
                p
                for p in on_table
                if p.object == shown.object and shown.texture in (p.texture, NEUTRAL_TEXTURE)
            ]
            assert len(fitting) == NUM_TWINS.get(task, {}).get(name, 1), name


@pytest.mark.parametrize("seed", range(12))
def test_words_and_relations_fit_the_objects_of_the_goals_alone(seed: int) -> None:
    twist, same_shape, understanding, neighbour = (
        sample_episode(task, level="L5", seed=seed).problem
        for task in ("twist", "same_shape", "scene_understanding", "manipulate_old_neighbor")
    )
    texture = re.findall(r"twist all (.*) objects", twist.prompt.text)[0]
    alike = {p.id for p in twist.scene.placements if p.texture == texture}
    assert alike == {goal.object_id for goal in twist.goals}  # type: ignore[union-attr]

    base = same_shape.prompt.images[0][1].placement  # type: ignore[union-attr]
    profile = object_spec(base.object).profile
    alike = {p.id for p in same_shape.scene.placements if object_spec(p.object).profile == profile}
    assert alike == {base.id, *(goal.object_id for goal in same_shape.goals)}  # type: ignore[union-attr]

    texture = re.findall(r"into the (.*) object\.", understanding.prompt.text)[0]
    (goal,) = understanding.goals
    assert [p.id for p in understanding.scene.placements if p.texture == texture] == [goal.relative_to]  # type: ignore[union-attr]

    dragged, meant = (neighbour.scene[goal.object_id] for goal in neighbour.goals)  # type: ignore[union-attr]
    direction = re.findall(r"its (\w+)", neighbour.prompt.text)[0]
    along = {"north": (-1, 0), "south": (1, 0), "west": (0, -1), "east": (0, 1)}[direction]

    def offset(placement: Placement) -> tuple[float, float]:
        dx, dy = placement.pose.x - dragged.pose.x, placement.pose.y - dragged.pose.y
        return dx * along[0] + dy * along[1], abs(dx * along[1] - dy * along[0])

    there = [p for p in neighbour.scene.placements if offset(p)[0] > offset(p)[1]]
    assert min(there, key=lambda p: sum(offset(p))) == meant


@pytest.mark.parametrize("seed", range(8))
def test_a_target_has_to_be_cleared_before_objects_are_rearranged(seed: int) -> None:
    problem = sample_episode("rearrange", level="L5", seed=seed, domain="eval").problem
    (clearing,) = problem.prerequisites
    (target,) = {
        goal.object_id: goal.target
        for goal in problem.goals
        if isinstance(goal, AtPose)
        and goal.target.planar_distance(problem.scene[clearing.object_id].pose) < 0.01
    }.values()
    moves = {goal.object_id: goal.target for goal in problem.goals if isinstance(goal, AtPose)}
    assert judged(problem, moves)[1].failure
    assert judged(problem, {clearing.object_id: clearing.target}, moves)[1].success
    assert clearing.target.planar_distance(target) > 0.1
