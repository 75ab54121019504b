"""Tasks of the levels beyond the published ones."""

import itertools
import re
from collections.abc import Iterable

import pytest

from openvima.catalog import object_spec, tasks_at
from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.scene import AtPose, ObjectImage, Placement, Problem, SceneImage
from openvima.tasks import sample_episode
from openvima.tasks.clutter import LEAST, MOST
from openvima.tasks.compositions import COMPOSITIONS, template
from openvima.tasks.table import offset
from task_cases import judge_step, judged, moves, played

SEEDS = range(5)


def sampled(task: str, seed: int, **options: object) -> Problem:
    return sample_episode(task, seed=seed, domain="eval", **options).problem


def fits(placement: Placement, named: str | Placement) -> bool:
    """Whether an object is of a texture, or of the shape of a gray image."""
    return named == placement.texture if isinstance(named, str) else named.object == placement.object


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", ["texture", "shape"])
def test_sorting_is_solved_by_the_containers_of_the_prompt_alone(kind: str, seed: int) -> None:
    problem = sampled(f"sort_by_{kind}", seed)
    images = {name: fill.placement for name, fill in problem.prompt.images if isinstance(fill, ObjectImage)}
    bases = [images[f"base_{n}"] for n in (1, 2, 3)]
    text = problem.prompt.text
    if kind == "texture":
        named: list = [text.split("all ")[n].split(" objects")[0] for n in (1, 2, 3)]
    else:
        named = [images[f"shape_{n}"] for n in (1, 2, 3)]
        assert {image.texture for image in named} == {NEUTRAL_TEXTURE}
    loose = [p for p in problem.scene.placements if not p.fixed]
    right = {p.id: base for p in loose for name, base in zip(named, bases, strict=True) if fits(p, name)}
    assert 6 <= len(right) <= 8 and len(loose) == len(right) + 1

    steps = [{object_id: base.pose} for object_id, base in right.items()]
    assert judged(problem, *steps)[1].success
    assert not judged(problem, *steps[:-1])[1].is_over
    first, base = next(iter(right.items()))
    for wrong in bases:
        assert judged(problem, {first: wrong.pose})[1].failure == (wrong is not base)
    distractor = next(p.id for p in loose if p.id not in right)
    assert judged(problem, {distractor: base.pose})[1].failure


@pytest.mark.parametrize("seed", SEEDS)
def test_a_pattern_is_built_from_the_image_with_cleared_targets(seed: int) -> None:
    problem = sampled("build_pattern", seed, num_distractors=2)
    ((_, image),) = problem.prompt.images
    assert isinstance(image, SceneImage)
    shown = {(p.object, p.texture): p.pose for p in image.scene.placements}
    objects = [p for p in problem.scene.placements if (p.object, p.texture) in shown]
    assert 6 <= len(objects) <= 8
    clear = [{goal.object_id: goal.target} for goal in problem.prerequisites]
    steps = [{p.id: shown[p.object, p.texture]} for p in objects]
    assert judged(problem, *clear, *steps)[1].success
    assert not clear or judged(problem, *steps)[1].failure


def test_an_order_is_reversed_whatever_the_way() -> None:
    problem = sampled("reverse_order", 1)
    row = [fill.placement for _, fill in problem.prompt.images if isinstance(fill, ObjectImage)]
    assert [p.pose.y for p in row] == sorted(p.pose.y for p in row)
    reached = {p.id: other.pose for p, other in zip(row, row[::-1], strict=True) if p is not other}
    assert {goal.object_id: goal.target for goal in problem.goals if isinstance(goal, AtPose)} == reached
    aside = [{goal.object_id: goal.target} for goal in problem.prerequisites]
    steps = [*aside, *({object_id: pose} for object_id, pose in reached.items())]
    assert len(steps) == 9
    outcomes = played(problem, *steps)
    assert outcomes[-1].success and not any(outcome.is_over for outcome in outcomes[:-1])


@pytest.mark.parametrize("seed", SEEDS)
def test_a_video_is_imitated_in_order_and_undone(seed: int) -> None:
    problem = sampled("imitate_then_undo", seed)
    frames = [fill.scene.placements for _, fill in problem.prompt.images if isinstance(fill, SceneImage)]
    ids = {(p.object, p.texture): p.id for p in problem.scene.placements}
    shown = [{ids[p.object, p.texture]: p.pose for p in frame} for frame in frames]
    assert len(shown) == 6 and len(problem.scene.placements) == 4
    assert all(problem.scene[object_id].pose == pose for object_id, pose in shown[0].items())
    there_and_back = [*shown[1:], *shown[-2::-1]]
    for before, after in itertools.pairwise(shown):
        assert sum(before[object_id] != after[object_id] for object_id in before) == 1
    assert [outcome.success for outcome in played(problem, *there_and_back)] == [False] * 9 + [True]
    assert not judged(problem, *shown[1:], shown[0])[1].success  # not step by step
    assert len(moves(problem)) == 10


CASES = [(name, seed) for name in COMPOSITIONS for seed in range(2)]


def num_fitting(shown: Placement, placements: Iterable[Placement]) -> int:
    """How many objects an image of an object may mean."""
    return sum(p.object == shown.object and shown.texture in (p.texture, NEUTRAL_TEXTURE) for p in placements)


def neighbor(problem: Problem, direction: str) -> Placement:
    """The object nearest to the first one to be moved, in a direction from it."""
    dragged = problem.scene[problem.goals[0].object_id]  # type: ignore[union-attr]
    step = {"north": (-1, 0), "south": (1, 0), "west": (0, -1), "east": (0, 1)}[direction]
    ways = {p.id: offset(p, dragged, step) for p in problem.scene.placements if p is not dragged}
    there = [problem.scene[i] for i, (along, aside) in ways.items() if along > aside]
    return min(there, key=lambda p: p.pose.planar_distance(dragged.pose))


def test_there_are_pairs_and_triples_of_instructions() -> None:
    numbers = [sum(kind != "define" for kind in kinds) for kinds in COMPOSITIONS.values()]
    assert set(numbers) == {2, 3} and len(set(map(template, COMPOSITIONS.values()))) == len(numbers) == 18


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_instructions_are_fulfilled_in_order_alone(name: str, seed: int) -> None:
    problem = sampled(name, seed)
    steps = moves(problem)
    outcomes = played(problem, *steps)
    assert outcomes[-1].success and not any(outcome.is_over for outcome in outcomes[:-1])
    last = steps[-2] if COMPOSITIONS[name][-1] == "restore" else steps[-1]
    assert judged(problem, last)[1].failure == (last is not steps[0])


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_a_prompt_means_one_object_and_a_distractor_in_a_base_is_a_failure(name: str, seed: int) -> None:
    problem = sampled(name, seed)
    placements, goals = problem.scene.placements, problem.goals
    for slot, fill in problem.prompt.images:
        assert not isinstance(fill, ObjectImage) or num_fitting(fill.placement, placements) == 1, slot
    if name.startswith("gather"):
        base = problem.scene[goals[0].relative_to]  # type: ignore[union-attr]
        alike = {p.id for p in placements if p.texture == base.texture}
        assert alike == {base.id, *(goal.object_id for goal in goals[:2])}  # type: ignore[union-attr]
    distractor = problem.constraints[-1].object_ids[0]  # type: ignore[union-attr]
    bases = [goal.target for goal in goals if goal.relative_to not in (None, goal.object_id)]  # type: ignore[union-attr]
    assert not bases or judged(problem, {distractor: bases[0]})[1].failure


@pytest.mark.parametrize("seed", range(6))
def test_the_neighbor_is_the_nearest_object_in_its_direction(seed: int) -> None:
    problem = sampled("put_then_neighbor", seed)
    word = problem.prompt.text.split(" at its ")[1].split()[0]
    assert neighbor(problem, word).id == problem.goals[1].object_id  # type: ignore[union-attr]


CASES_CLUTTER = [(task, seed) for task in tasks_at("L5") for seed in range(2)]
NUM_TWINS = {"novel_adj": {"dragged_obj": 2}}  # of one shape; the adjective tells them apart


def added(problem: Problem) -> list[Placement]:
    """Objects of the clutter: those of the last constraint."""
    return [problem.scene[i] for i in problem.constraints[-1].object_ids]  # type: ignore[union-attr]


@pytest.mark.parametrize(("task", "seed"), CASES_CLUTTER)
def test_clutter_is_large_distinct_and_decides_nothing(task: str, seed: int) -> None:
    problem = sampled(task, seed, level="L5")
    looks = [(p.object, p.texture) for p in added(problem)]
    assert LEAST <= len(looks) <= MOST and len(set(looks)) == len(looks)
    if task != "follow_order":  # there a step has to fulfil a goal
        assert not judge_step(problem, {}).is_over
    on_table = [p for p in problem.scene.placements if p.object != "small block"]
    for name, fill in problem.prompt.images:
        if isinstance(fill, ObjectImage) and not name.startswith(("demo_", "swept")):
            num_twins = NUM_TWINS.get(task, {}).get(name, 1)
            assert num_fitting(fill.placement, on_table) == num_twins, name


@pytest.mark.parametrize("seed", range(6))
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

    direction = re.findall(r"its (\w+)", neighbour.prompt.text)[0]
    assert neighbor(neighbour, direction).id == neighbour.goals[1].object_id  # type: ignore[union-attr]


@pytest.mark.parametrize("seed", range(5))
def test_a_target_has_to_be_cleared_before_objects_are_rearranged(seed: int) -> None:
    problem = sampled("rearrange", seed, level="L5")
    (clearing,) = problem.prerequisites
    blocked = problem.scene[clearing.object_id].pose
    targets = {i: pose for move in moves(problem) for i, pose in move.items()}
    (target,) = [pose for pose in targets.values() if pose.planar_distance(blocked) < 0.01]
    assert judged(problem, targets)[1].failure
    assert judged(problem, {clearing.object_id: clearing.target}, targets)[1].success
    assert clearing.target.planar_distance(target) > 0.1
