"""Families, and published rates by task."""

import re
from dataclasses import replace

import pytest

from openvima.catalog.partitions import PUBLISHED_TASKS
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.statistics import mean_of_rates
from openvima.report import write_report
from openvima.report.figures import (
    RateFigure,
    RatePoint,
    rate_figure_html,
)
from openvima.report.published import has_published_tasks, models_by_task
from openvima.report.table import Estimate, Table
from openvima.report.tables import FAMILIES, family_table, result_table
from openvima.tasks import task_spec


def row(policy: str, task: str, level: str, solved: int, ablation: str = "") -> Row:
    outcomes = tuple(EpisodeOutcome(i, i < solved, 2, "" if i < solved else "lost") for i in range(20))
    return Row(policy, task, level, 1, outcomes, ablation)


def cells(table: Table) -> dict[str, list[str]]:
    return {
        line.name + (f" {line.cells[0]}" if isinstance(line.cells[0], str) else ""): [
            cell.written if isinstance(cell, Estimate) else cell for cell in line.cells
        ]
        for line in table.lines
    }


def test_families_are_those_of_the_published_tasks():
    assert {family for task in PUBLISHED_TASKS for family in task_spec(task).families} == set(FAMILIES)


def test_family_means_weight_tasks_alike_and_leave_unknown_tasks_out():
    solved = {"visual_manipulation": 20, "rotate": 10, "twist": 4, "stack<b>": 20}
    results = Results(tuple(row("mine", task, "L1", number) for task, number in solved.items()))
    table = family_table(results)
    assert cells(table)["simple object manipulation (2) L1"] == ["L1", "75.0", "99.8"]
    assert not any("stack" in name for name in cells(table))
    first = table.lines[0].cells[1]
    assert isinstance(first, Estimate) and first.interval == mean_of_rates([(20, 20), (10, 20)])[1]
    assert family_table(results, published=False).columns == ("family", "level", "mine")


@pytest.fixture
def ablated() -> Results:
    plain = [row("mine", task, "L1", n) for task, n in (("rotate", 20), ("twist", 10))]
    masked = [row("mine", task, "L1", n, "masked_words:0.5") for task, n in (("rotate", 8), ("twist", 4))]
    more = [row("mine", task, "L1", 0, "masked_words:1") for task in ("rotate", "twist")]
    # a task without the option, or whose tables are too small for so many, leaves the whole panel
    crowded = [row("mine", task, "L1", 12, "num_distractors:2") for task in ("rotate", "twist")]
    full = [row("mine", "rotate", "L1", 6, "num_distractors:6")]
    other = [row("mine", "rotate", "L1", 1, name) for name in ("no_prompt", "masked_words:1+noisy_boxes:3")]
    return Results((*plain, *masked, *more, *crowded, *full, *other))


def test_all_published_rates_by_task_stand_beside_measured_ones():
    results = Results((row("mine", "rotate", "L1", 10), row("mine", "twist", "L1", 5)))
    table = result_table(results, published=True)
    found = cells(table)
    assert has_published_tasks(results) and len(table.columns) == 3 + len(models_by_task(results))
    assert found["rotate L1"][:3] == ["L1", "50.0", "99.5"]
    assert found["twist L1"] == ["L1", "25.0", "18.0", "100.0", "20.5", "25.0", "50.0"]
    assert found["mean L1"][:3] == ["L1", "37.5", "–"]
    assert "A by way of B" in table.caption
    assert not has_published_tasks(Results((row("mine", "rotate", "train", 1),)))


def test_the_page_shows_all_of_them(ablated, tmp_path):
    more = replace(ablated, rows=(*ablated.rows, row("mine", "rotate", "L3", 3)))
    text = write_report(more, tmp_path / "report.html").read_text("utf-8")
    assert all(f'<section id="{name}">' in text for name in ("families", "published", "ablations"))
    assert "All published rates by task" in text and "reliability" in text.lower()
    assert "masked words 1 + noisy boxes 3" in text
    plain = replace(ablated, rows=ablated.rows[:2], config={"prompts": "text"})
    text = write_report(plain, tmp_path / "plain.html").read_text("utf-8")
    assert not any(f'<section id="{name}">' in text for name in ("published",))


def figure() -> RateFigure:
    own = {("mi<ne", False): [RatePoint(0.01, 0.2, (0.1, 0.3)), RatePoint(1, 0.5, (0.4, 0.6))]}
    others = {"VIMA 92M": (0.763, 0.496), "MIDAS 92M": (0.978, 0.591)}
    panels = {
        level: own | {(name, True): [RatePoint(1, rates[k])] for name, rates in others.items()}
        for k, level in enumerate(("L1", "L4"))
    }
    return RateFigure("Success.", "fraction", panels, {0.01: "1 %", 1: "100 %"}, logarithmic=True)


def test_charts_tell_measured_from_published_curves_and_share_colours():
    text = rate_figure_html(figure())
    charts = re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL)
    assert len(charts) == 2 and "mi&lt;ne" in text and "mi<ne" not in text
    assert all("var(--series-1)" in chart and "var(--series-2)" in chart for chart in charts)
    assert text.count('class="dot hollow"') == 2 and "VIMA 92M (published)" in text
    assert all(chart.count("stroke-dasharray") >= 2 for chart in charts)
    names = re.findall(r'\bid="([^"]*)"', text)
    assert len(names) == len(set(names))
