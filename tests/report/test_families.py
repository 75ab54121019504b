"""Families, and published rates by task."""

import re
from dataclasses import replace

import pytest

from openvima.catalog.partitions import PUBLISHED_TASKS
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.statistics import mean_of_rates
from openvima.report import write_report
from openvima.report.figures import (
    RateCurve,
    RateFigure,
    RatePoint,
    rate_figure_html,
    rate_table,
)
from openvima.report.published import (
    models_by_task,
    published_task_table,
)
from openvima.report.table import Estimate, Table, markdown
from openvima.report.tables import FAMILIES, family_table
from openvima.tasks import task_spec


def row(policy: str, task: str, level: str, solved: int, ablation: str = "") -> Row:
    outcomes = tuple(EpisodeOutcome(i, i < solved, 2, "" if i < solved else "lost") for i in range(20))
    return Row(policy, task, level, 1, outcomes, ablation)


def cells(table: Table | None) -> dict[str, list[str]]:
    assert table
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
    table = published_task_table(Results((row("mine", "rotate", "L1", 10), row("mine", "twist", "L3", 5))))
    found = cells(table)
    assert table and len(table.columns) == 3 + len(models_by_task())
    assert found["rotate L1"][:3] == ["L1", "50.0", "99.5"]
    assert found["twist L1"] == ["L1", "–", "18.0", "100.0", "20.5", "–", "25.0", "50.0"]
    assert found["rearrange_then_restore L1"] == ["L1", "–", "56.5", "94.0", "~88.0", "~65.0", "90.0", "65.0"]
    assert found["manipulate_old_neighbor L3"][2:4] == ["46.0", "47.0"]
    assert "A by way of B" in table.caption
    assert published_task_table(Results((row("mine", "rotate", "train", 1),))) is None


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
    own = RateCurve("mi<ne", (RatePoint(0.01, 0.2, (0.1, 0.3)), RatePoint(1, 0.5, (0.4, 0.6))))
    others = {"VIMA 92M": (0.763, 0.496), "MIDAS 92M": (0.978, 0.591)}
    panels = {
        level: (own, *(RateCurve(name, (RatePoint(1, r[k], mark="*"),), True) for name, r in others.items()))
        for k, level in enumerate(("L1", "L4"))
    }
    return RateFigure("data", "Success.", "fraction", panels, {0.01: "1 %", 1: "100 %"}, logarithmic=True)


def test_the_table_has_a_row_for_each_curve_of_each_panel():
    text = markdown([rate_table(figure())])
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    assert rows[0] == ["policy", "level", "1 %", "100 %"]
    assert rows[2] == ["mi\\<ne", "L1", "20.0 (10.0 to 30.0)", "50.0 (40.0 to 60.0)"]
    assert rows[3] == ["VIMA 92M (published)", "L1", "–", "76.3\\*"]
    assert rows[-1][0] == "MIDAS 92M (published)" and rows[-1][-1] == "59.1\\*"


def test_charts_tell_measured_from_published_curves_and_share_colours():
    text = rate_figure_html(figure())
    charts = re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL)
    assert len(charts) == 2 and "mi&lt;ne" in text and "mi<ne" not in text
    assert all("var(--series-1)" in chart and "var(--series-2)" in chart for chart in charts)
    assert text.count('class="dot hollow"') == 2 and "VIMA 92M (published)" in text
    assert all(chart.count("stroke-dasharray") >= 2 for chart in charts)
    names = re.findall(r'\bid="([^"]*)"', text)
    assert len(names) == len(set(names))
