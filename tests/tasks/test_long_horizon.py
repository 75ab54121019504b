"""Level L8: what counts as solved, and what does not, over six to twelve steps."""

import itertools

import pytest

from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.scene import AtPose, ObjectImage, Placement, Pose, Problem, SceneImage
from openvima.tasks import sample_episode
from task_cases import judged, played

SEEDS = range(5)


def sampled(task: str, seed: int, **options: object) -> Problem:
    return sample_episode(task, seed=seed, domain="eval", **options).problem


def moves(problem: Problem) -> list[dict[int, Pose]]:
    """One step for each goal, in order."""
    return [{goal.object_id: goal.target} for goal in problem.goals if isinstance(goal, AtPose)]


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


@pytest.mark.parametrize("num_objects", [4, 5, 6])
def test_an_order_is_reversed_whatever_the_way(num_objects: int) -> None:
    problem = sampled("reverse_order", 1, num_objects=num_objects)
    row = [fill.placement for _, fill in problem.prompt.images if isinstance(fill, ObjectImage)]
    assert [p.pose.y for p in row] == sorted(p.pose.y for p in row)
    reached = {p.id: other.pose for p, other in zip(row, row[::-1], strict=True) if p is not other}
    assert {goal.object_id: goal.target for goal in problem.goals if isinstance(goal, AtPose)} == reached
    aside = [{goal.object_id: goal.target} for goal in problem.prerequisites]
    steps = [*aside, *({object_id: pose} for object_id, pose in reached.items())]
    assert len(steps) == 3 * (num_objects // 2)
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
