"""Level L7: sentences of the grammar mean one thing, which a resolver that reads them finds as well."""

import re
from dataclasses import replace
from functools import cache

import pytest

from openvima.catalog.partitions import tasks_at
from openvima.scene import AtPose, Placement, Pose, Problem, Scene
from openvima.tasks import sample_episode
from openvima.tasks.referring_grammar import PHRASES, are_distinct, sentence, templates
from openvima.tasks.registry import held_out_tasks, named_tasks
from referring import AmbiguousError, disagreement, measure, read
from task_cases import judge_step, judged

TEMPLATES = [(kind, number) for kind in PHRASES for number in range(len(templates(kind)))]
SEED = 3


def sampled(kind: str, seed: int = SEED) -> Problem:
    return sample_episode(f"refer_by_{kind}", seed=seed).problem


def follows(text: str, template: str) -> bool:
    """Whether a prompt fills the words of a template; images keep their slots."""
    pieces = re.split(r"({\w+})", template)
    is_image = re.compile(r"{(object_\d|base|target)}").fullmatch
    patterns = (r"[\w -]+" if p[:1] == "{" and not is_image(p) else re.escape(p) for p in pieces)
    return re.fullmatch("".join(patterns), text) is not None


@cache
def seeds_by_template(kind: str) -> dict[int, list[int]]:
    """Return seeds by the number of their template: of those that fit, the one with most words of its own."""
    found: dict[int, list[int]] = {}
    texts = [sentence(*template) for template in templates(kind)]
    for seed in range(7 * len(texts)):
        text = sampled(kind, seed).prompt.text
        fitting = [number for number, template in enumerate(texts) if follows(text, template)]
        number = max(fitting, key=lambda n: len(re.sub(r"{\w+}", "", texts[n])))
        found.setdefault(number, []).append(seed)
    return found


def goals_of(problem: Problem) -> list[AtPose]:
    return [goal for goal in problem.goals if isinstance(goal, AtPose)]


def test_there_are_many_templates_and_the_tasks_are_held_out() -> None:
    texts = {sentence(*template) for kind in PHRASES for template in templates(kind)}
    assert len(texts) == len(TEMPLATES) == 82
    assert set(tasks_at("L7")) == {f"refer_by_{kind}" for kind in PHRASES}
    assert set(tasks_at("L7")) <= set(held_out_tasks()) - set(named_tasks(["heldout"]))


@pytest.mark.parametrize(("kind", "number"), TEMPLATES)
def test_every_template_is_reached_and_its_sentence_read_as_meant(kind: str, number: int) -> None:
    seed = seeds_by_template(kind)[number][0]
    episode = sample_episode(f"refer_by_{kind}", seed=seed, prompts="text")
    assert disagreement(episode) == "", episode.problem.prompt.text
    assert "{" not in episode.problem.prompt.text
    assert episode.max_steps <= 7


@pytest.mark.slow
@pytest.mark.parametrize("task", tasks_at("L7"))
def test_sampler_and_resolver_agree_on_two_thousand_sentences(task: str) -> None:
    row = measure(task, range(400))
    assert row["differing"] == [] and row["failed"] == 0 and row["distinct"] > 280


@pytest.mark.parametrize("kind", PHRASES)
def test_the_resolver_notices_another_goal(kind: str) -> None:
    episode = sample_episode(f"refer_by_{kind}", seed=SEED, prompts="text")
    problem, goals = episode.problem, goals_of(episode.problem)
    meant = {goal.object_id for goal in goals}
    other = next(p for p in problem.scene.placements if p.id not in meant and not p.fixed)
    wrong = goals[0].renumbered(
        {p.id: p.id for p in problem.scene.placements} | {goals[0].object_id: other.id}
    )
    wrong = replace(problem, goals=(wrong, *goals[1:]))
    assert disagreement(replace(episode, problem=wrong))


def test_the_resolver_takes_the_pictures_view_and_refuses_what_is_not_clear() -> None:
    def put(number: int, x: float, y: float, texture: str, width: float = 0.1) -> Placement:
        return Placement(number, "star", texture, (width, width, 0.03), Pose.planar(x, y))

    low_left, low_right = put(5, 0.7, -0.3, "red"), put(6, 0.7, 0.3, "blue", 0.14)
    scene = Scene((low_left, low_right, put(7, 0.4, 0.0, "green")))

    def objects(phrase: str) -> set[int]:
        return set(read(f"Rotate {phrase} 30 degrees.", scene).objects)

    assert objects("the leftmost star") == objects("the red object left of the blue star") == {5}
    assert objects("the largest star") == objects("the blue object right of the red star") == {6}
    assert objects("the rearmost star") == objects("the green star behind the red star") == {7}
    for unclear in (
        "the frontmost star",
        "the smallest star",
        "the star nearest to the green star",
        "the ring",
    ):
        with pytest.raises(AmbiguousError):
            objects(unclear)


@pytest.mark.parametrize("kind", PHRASES)
@pytest.mark.parametrize("seed", range(3))
def test_what_is_meant_solves_an_episode_and_any_other_object_fails(kind: str, seed: int) -> None:
    problem = sampled(kind, seed=seed)
    goals = goals_of(problem)
    required = problem.num_required or len(goals)
    meant = {goal.object_id: goal.target for goal in goals}
    assert not judge_step(problem, {}).is_over
    assert judged(problem, dict(list(meant.items())[:required]))[-1].success
    base = goals[0].relative_to
    if base not in meant:
        for other in problem.scene.placements:
            if other.id not in meant and not other.fixed:
                assert judged(problem, {other.id: goals[0].target})[-1].failure


def test_one_more_than_the_number_and_the_wrong_one_of_two_containers_are_failures() -> None:
    problem = sampled("number", seeds_by_template("number")[0][0])
    assert problem.num_required == 1
    both = {goal.object_id: goal.target for goal in goals_of(problem)[:2]}
    assert judged(problem, both)[-1].failure
    problem = sampled("relation", seeds_by_template("relation")[2][0])
    (goal,) = goals_of(problem)
    (other,) = [p for p in problem.scene.placements if p.fixed and p.id != goal.relative_to]
    assert problem.scene[goal.relative_to or 0].object == other.object
    assert judged(problem, {goal.object_id: other.pose})[-1].failure


@pytest.mark.parametrize("kind", PHRASES)
def test_no_two_objects_look_alike_and_no_texture_is_part_of_another(kind: str) -> None:
    for seed in range(10):
        placements = sampled(kind, seed=seed).scene.placements
        assert len({(p.object, p.texture) for p in placements}) == len(placements)
        assert are_distinct(sorted({p.texture for p in placements}))


@pytest.mark.parametrize("template", [0, 1])
def test_both_alternatives_occur(template: int) -> None:
    first = []
    seeds = seeds_by_template("alternative")[template]
    for seed in seeds:
        problem = sampled("alternative", seed)
        shown = dict(problem.prompt.images)["object_1"].placement  # type: ignore[union-attr]
        moved = problem.scene[goals_of(problem)[0].object_id]
        first.append((shown.object, shown.texture) == (moved.object, moved.texture))
    assert 0.2 < sum(first) / len(seeds) < 0.8
