"""Points, differences and page of a study, from made-up evaluations."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("matplotlib")
pytest.importorskip("jinja2")

from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.studies import StudyInputs, make_study, scale_named
from openvima.studies.plan import COST_FILE, Plan, plan_study
from openvima.studies.results import Point, study_costs, study_figure, study_page, study_points
from openvima.studies.study import Study
from openvima.tasks.registry import task_spec

EPISODES = 6


def made_up(name: str, folder: Path, seeds: int = 2) -> tuple[Study, Plan, list[Point]]:
    """A study whose evaluations have made-up outcomes, of which the first seed of training solves more."""
    scale = replace(scale_named("nano"), episodes=EPISODES)
    inputs = StudyInputs(scale, ("a=oracle", "b=random") if name == "corrupted-prompts" else ())
    study = make_study(name, inputs)
    plan = plan_study(study, inputs, folder, seeds=seeds)
    for index, evaluation in enumerate(plan.evaluations):
        config = evaluation.config
        rows = [
            Row("policy", task, level, 2, _outcomes(config.seed, (index + len(ablation)) % 5), ablation)
            for ablation in ("", *config.ablations)
            for level in config.levels
            for task in config.tasks
            if level in task_spec(task).levels
        ]
        Results(tuple(rows)).write(config.out / "results.json")
    costs = {"parameters": 10**6, "demonstrations": 9, "steps": {"2-cloning": 7}, "cpu_seconds": 90.0}
    for training in plan.all_trainings:
        training.config.out.mkdir(parents=True)
        (training.config.out / COST_FILE).write_text(json.dumps(costs))
    return study, plan, study_points(plan)


def _outcomes(first: int, solved: int) -> tuple[EpisodeOutcome, ...]:
    return tuple(EpisodeOutcome(first + i, i < solved, 1) for i in range(EPISODES))


@pytest.mark.parametrize(
    ("name", "panels", "named"),
    [
        ("data-scaling", ["L1", "L2", "L3", "L4"], False),
        ("corrupted-prompts", ["L1", "L4"], True),
        ("distractors", ["L1", "L2", "L3", "L4"], False),
        ("level-drop", ["All levels"], True),
        ("midas", ["L1", "L2", "L3", "L4"], True),
    ],
)
def test_a_figure_has_the_panels_and_the_axis_of_the_study(
    name: str, panels: list[str], named: bool, tmp_path: Path
) -> None:
    study, _, points = made_up(name, tmp_path)
    figure = study_figure(study, points)
    assert list(figure.panels) == panels
    assert figure.named == named
    assert all(points for curves in figure.panels.values() for points in curves.values())


@pytest.mark.parametrize("name", ["corrupted-prompts", "level-drop", "midas"])
def test_a_page_shows_every_run_and_loads_nothing(name: str, tmp_path: Path) -> None:
    study, plan, points = made_up(name, tmp_path)
    page = study_page(plan, points, costs=study_costs(plan), versions={}, command="openvima study")
    assert all(run.label in page for run in study.runs)
    assert "src=" not in page and "@import" not in page
    assert ("Training seeds</h2>" in page) == bool(plan.trainings) == ("Costs</h2>" in page)


def test_points_hold_seeds_and_differences_on_the_same_episodes(tmp_path: Path) -> None:
    _, _, points = made_up("data-scaling", tmp_path)
    first, second = (p for p in points if p.level == "L1" and p.run in ("0.1 %", "1 %"))
    assert [mean for mean, _ in first.score.seeds] == [0, 1 / EPISODES]
    assert first.x == 0.001 and first.difference is None
    assert [mean for mean, _ in second.score.seeds] == [2 / EPISODES, 3 / EPISODES]
    assert second.difference == pytest.approx(2 / EPISODES)


def test_ablations_are_paired_with_plain_scores_unless_scenes_differ(tmp_path: Path) -> None:
    _, _, points = made_up("corrupted-prompts", tmp_path / "corrupted")
    plain, masked = (p for p in points if (p.run, p.level) == ("a", "L1") and p.ablation in ("", "no_prompt"))
    assert plain.x == "as it is" and plain.difference is None
    assert masked.x == "no prompt" and masked.difference is not None
    _, _, points = made_up("distractors", tmp_path / "distractors")
    assert {p.x for p in points} == {0, 1, 2, 4, 6}
    assert all(p.difference is None for p in points)
