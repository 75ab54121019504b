"""Nothing that a policy sees in some order tells it what to pick, or where to put it."""

import collections
from collections.abc import Iterator

import pytest

from openvima.scene import Episode, SceneImage
from openvima.tasks import sample_episode, task_spec
from task_cases import REPRESENTATIVE_TASKS

NUM_EPISODES = 200
# Standard deviations of a chi-square statistic; chance exceeds it less than once in 100,000 tests.
LIMIT = 6.0

Ranks = dict[str, collections.Counter[tuple[int, int]]]


def observations(episode: Episode) -> Iterator[tuple[str, int, int]]:
    """Kind of order, number of things in it, and the rank of the one that the answer is about."""
    problem = episode.problem
    ids = [placement.id for placement in problem.scene.placements]
    goal = problem.goals[0]
    yield "object to move among all ids", len(ids), ids.index(goal.object_id)
    if goal.relative_to is not None:
        yield "base among all ids", len(ids), ids.index(goal.relative_to)
    movable = [placement.id for placement in problem.scene.placements if not placement.fixed]
    yield "object to move among movable ones", len(movable), movable.index(goal.object_id)
    target = problem.scene[goal.object_id]
    for _, fill in problem.prompt.images:
        if isinstance(fill, SceneImage):
            looks = [(placement.object, placement.texture) for placement in fill.scene.placements]
            if looks.count((target.object, target.texture)) == 1:
                yield (
                    "object to move in a scene image",
                    len(looks),
                    looks.index((target.object, target.texture)),
                )
                break  # frames of one motion share their ids


def ranks(task: str, level: str, *, compat: bool = False) -> Ranks:
    """How often the answer had each rank, by the kind of order and its length."""
    found: Ranks = collections.defaultdict(collections.Counter)
    for seed in range(NUM_EPISODES):
        for kind, length, rank in observations(sample_episode(task, level=level, seed=seed, compat=compat)):
            found[kind][length, rank] += 1
    return found


def excess(counts: collections.Counter[tuple[int, int]]) -> float:
    """Chi-square statistic of the ranks against chance, in standard deviations above its mean."""
    statistic = freedom = 0.0
    for length in {length for length, _ in counts}:
        of_length = [counts[length, rank] for rank in range(length)]
        expected = sum(of_length) / length
        if length > 1 and expected >= 5:
            statistic += sum((count - expected) ** 2 / expected for count in of_length)
            freedom += length - 1
    return (statistic - freedom) / (2 * freedom) ** 0.5 if freedom else 0.0


@pytest.mark.parametrize(
    ("task", "level"),
    [
        *((task, task_spec(task).levels[0]) for task in REPRESENTATIVE_TASKS),
        *((task, "L5") for task in ("rearrange", "visual_manipulation")),
    ],
)
@pytest.mark.slow
def test_no_rank_in_any_order_predicts_the_answer(task: str, level: str) -> None:
    found = ranks(task, level)
    assert {kind: excess(counts) for kind, counts in found.items() if excess(counts) > LIMIT} == {}


@pytest.mark.slow
def test_the_original_order_gives_the_answer_away() -> None:
    """The same test finds the leak of the original benchmark, where objects come in the order of roles."""
    found = ranks("visual_manipulation", "L1", compat=True)
    assert found["object to move among all ids"] == {(3, 1): NUM_EPISODES}
    assert excess(found["base among all ids"]) > 10 * LIMIT
