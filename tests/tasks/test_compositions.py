"""Level L6: several instructions, each as in its task, in the order of the prompt."""

import pytest

from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.scene import AtPose, ObjectImage, Pose, Problem
from openvima.tasks import sample_episode
from openvima.tasks.compositions import COMPOSITIONS, offset, template
from task_cases import judged, played

SEEDS = range(3)
CASES = [(name, seed) for name in COMPOSITIONS for seed in SEEDS]


def sampled(name: str, seed: int, **options: object) -> Problem:
    return sample_episode(name, seed=seed, domain="eval", **options).problem


def steps_of(problem: Problem) -> list[dict[int, Pose]]:
    return [{goal.object_id: goal.target} for goal in problem.goals if isinstance(goal, AtPose)]


def test_there_are_pairs_and_triples_of_instructions() -> None:
    numbers = [sum(kind != "define" for kind in kinds) for kinds in COMPOSITIONS.values()]
    assert numbers.count(2) >= 12 and numbers.count(3) >= 4 and set(numbers) == {2, 3}
    assert len(set(COMPOSITIONS.values())) == len({template(kinds) for kinds in COMPOSITIONS.values()}) == 18


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_instructions_are_fulfilled_in_order_alone(name: str, seed: int) -> None:
    problem = sampled(name, seed)
    steps = steps_of(problem)
    outcomes = played(problem, *steps)
    assert outcomes[-1].success and not any(outcome.is_over for outcome in outcomes[:-1])
    last = steps[-2] if COMPOSITIONS[name][-1] == "restore" else steps[-1]
    assert judged(problem, last)[1].failure == (last is not steps[0])


@pytest.mark.parametrize(("name", "seed"), CASES)
def test_a_prompt_means_one_object_and_a_distractor_in_a_base_is_a_failure(name: str, seed: int) -> None:
    problem = sampled(name, seed)
    placements, goals = problem.scene.placements, problem.goals
    for slot, fill in problem.prompt.images:
        if isinstance(fill, ObjectImage):
            shown = fill.placement
            fitting = [
                p
                for p in placements
                if p.object == shown.object and shown.texture in (p.texture, NEUTRAL_TEXTURE)
            ]
            assert len(fitting) == 1, slot
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
    dragged, neighbor = (problem.scene[goal.object_id] for goal in problem.goals)  # type: ignore[union-attr]
    word = problem.prompt.text.split(" at its ")[1].split()[0]
    step = {"north": (-1, 0), "south": (1, 0), "west": (0, -1), "east": (0, 1)}[word]
    there = [p for p in problem.scene.placements if offset(p, dragged, step)[0] > offset(p, dragged, step)[1]]
    assert min(there, key=lambda p: p.pose.planar_distance(dragged.pose)) == neighbor
