"""Tables for papers: right numbers, and text that Markdown and LaTeX can read."""

import re
from dataclasses import replace

import pytest

from openvima.evaluation.comparison import compare_pairs
from openvima.evaluation.results import Results
from openvima.report.table import latex, markdown
from openvima.report.tables import paper_tables


@pytest.fixture
def tables(results):
    controlled = tuple(
        replace(row, ablation="no_prompt", outcomes=row.outcomes[5:])
        for row in results.rows
        if row.policy == "mine"
    )
    more = replace(results, rows=(*results.rows, *controlled))
    return paper_tables(more, compare_pairs(more, [("mine", "random"), ("mine:no_prompt", "mine")]))


def cells_of(text: str, name: str) -> list[list[str]]:
    """Cells of all rows of that name in Markdown."""
    lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith(f"| {name} ")]
    return [line[1:] for line in lines]


def test_tables_are_those_a_paper_prints(tables):
    assert [table.label for table in tables] == [
        "levels",
        "families",
        "tasks-mine",
        "tasks-oracle",
        "tasks-random",
        "results",
        "input-ablations-mine",
        "difference-mine-random",
        "difference-mine-no_prompt-mine",
    ]
    assert all(len(line.cells) == len(table.columns) - 1 for table in tables for line in table.lines)


def test_markdown_holds_means_with_intervals_and_published_numbers(tables, results):
    text = markdown(tables)
    mean = next(m for m in results.level_means() if (m.policy, m.level) == ("mine", "L1"))
    expected = f"75.0 ({100 * mean.interval[0]:.1f} to {100 * mean.interval[1]:.1f})"
    assert cells_of(text, "mine")[0][0] == expected
    assert cells_of(text, "rotate")[0][0] == "90.0 (59.6 to 98.2)"
    assert cells_of(text, "VIMA 200M (published)") == [["–", "100.0"]]  # over the same tasks
    assert "were not measured here" in text
    assert "(published)" not in markdown(paper_tables(results, published=False))


def test_differences_show_counts_and_mark_noise(tables):
    text = markdown(tables)
    rotate = next(cells for cells in cells_of(text, "rotate") if "9 : 0" in cells)
    assert [rotate[0], rotate[2]] == ["L1", "9 : 0"]
    assert any("≈" in cell for cells in cells_of(text, "stack\\<b>") for cell in cells)


def test_captions_say_whether_outcomes_were_confirmed_by_replay(results):
    marked, plain = (paper_tables(results, confirmed=confirmed) for confirmed in (True, False))
    assert all("confirmed by replaying the recorded actions" in table.caption for table in marked)
    assert "`openvima verify-results`" in plain[0].caption
    assert not any("confirmed" in table.caption for table in plain[1:])


def test_latex_is_balanced_escaped_and_whole_in_each_row(tables):
    text = latex(tables)
    begun, ended = re.findall(r"\\begin{(\w+)}", text), re.findall(r"\\end{(\w+)}", text)
    assert sorted(begun) == sorted(ended) and len(begun) == 2 * len(tables)
    body = "\n".join(line for line in text.splitlines() if not line.startswith("%"))
    plain = re.sub(r"\\[\\%&_#${}]", "", re.sub(r"\\(label|begin|end){[^}]*}", "", body))
    assert plain.count("{") == plain.count("}")
    assert not re.search(r"[_#~^<>%]", plain)
    assert plain.count("$") % 2 == 0
    assert "stack\\textless{}b\\textgreater{}" in text
    assert "−" not in text and "≈" not in text
    for part in text.split("\\begin{tabular}")[1:]:
        columns = len(re.match(r"{(\w+)}", part)[1])
        rows = [line for line in part.splitlines() if line.endswith("\\\\")]
        assert rows and all(len(re.findall(r"(?<!\\)&", row)) == columns - 1 for row in rows)
        assert all(f"\\{rule}rule" in part for rule in ("top", "mid", "bottom"))


def test_means_over_fewer_tasks_than_others_say_so(results):
    (first, *_), level = results.tasks("L1"), "L1"
    rows = tuple(
        row for row in results.rows if row.policy != "random" or (row.task, row.level) == (first, level)
    )
    text = markdown(paper_tables(replace(results, rows=rows)))
    assert cells_of(text, "random")[0][0].endswith(f") 1 of {len(results.tasks('L1'))} tasks")
    assert "tasks" not in cells_of(text, "mine")[0][0]


def test_other_prompts_are_named_and_not_compared_with_published_ones(results: Results) -> None:
    text = replace(results, config={**results.config, "prompts": "text"})
    assert "(published)" in markdown(paper_tables(results))
    first = markdown(paper_tables(text)[:1])
    assert "(published)" not in first and "Prompts: text." in first


def test_a_weak_difference_is_marked_in_markdown_and_latex(results):
    comparison = compare_pairs(results, [("mine", "random")])[0]
    weak = replace(comparison.tasks[0], difference=0.3, interval=(0.1, 0.5), p_holm=0.2)
    assert weak.verdict == "unsure"
    tables = paper_tables(results, [replace(comparison, tasks=(weak, *comparison.tasks[1:]))])
    assert "+30.0 (+10.0 to +50.0) ?" in markdown(tables)
    assert r"+30.0 {\footnotesize(+10.0 to +50.0)} ?" in latex(tables)
    assert "?: weak" in tables[-1].caption
