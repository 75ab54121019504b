"""The report: whole in one file, right numbers, readable HTML."""

import json
import re
from html.parser import HTMLParser

import pytest

from openvima.errors import DatasetError
from openvima.evaluation.clips import load_clips, save_clips
from openvima.evaluation.report import write_report
from openvima.evaluation.report.curves import read_charts
from openvima.evaluation.results import Results

VOID = {"meta", "link", "img", "br", "input"}


class Page(HTMLParser):
    """Collects what the tests ask about, and checks that elements nest."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.resources: list[str] = []
        self.ids: list[str] = []
        self.tables: list[list[list[str]]] = []
        self.tags: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == [], f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags.append(tag)
        self.resources += [values[name] for name in ("src", "href", "poster", "data") if values.get(name)]
        if "id" in values:
            self.ids.append(values["id"])
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "table" in self.open and self.tables[-1] and self.tables[-1][-1]:
            self.tables[-1][-1][-1] += data + " "


@pytest.fixture
def metrics(tmp_path):
    path = tmp_path / "metrics.jsonl"
    values = [(i, 3.0 / (i + 1), i / 50) for i in range(50)]
    lines = [{"step": i, "loss": a, "validation_loss": 1.1 * a, "accuracy": b} for i, a, b in values]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


@pytest.fixture
def text(results, clip, metrics, tmp_path) -> str:
    path = write_report(results, tmp_path / "report.html", metrics=metrics, clips=[clip])
    return path.read_text(encoding="utf-8")


def test_the_page_needs_nothing_from_elsewhere(text):
    page = Page(text)
    assert all(resource.startswith(("data:", "#")) for resource in page.resources)
    assert not re.search(r"https?://|@import|url\((?!#)", text)
    assert "script" not in page.tags
    assert {"video", "svg", "table", "img"} <= set(page.tags)


def test_the_page_is_well_formed_and_its_names_are_unique(text):
    page = Page(text)
    assert text.startswith("<!DOCTYPE html>")
    assert len(page.ids) == len(set(page.ids))
    used = set(re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', text))
    assert {a or b for a, b in used} <= set(page.ids)


def test_the_table_shows_rates_intervals_and_counts(text):
    table = Page(text).tables[0]
    assert [cell.strip() for cell in table[0]] == ["task", "mine", "oracle", "random"]
    rotate = next(row for row in table if row[0].strip() == "rotate")
    assert "90 %" in rotate[1] and "60–98 · 9/10" in rotate[1]
    assert "100 %" in rotate[2]
    mean = next(row for row in table if row[0].strip() == "mean of 2")
    assert "75.0 %" in mean[1]


def test_the_headline_is_that_of_the_trained_policy(text):
    assert "<h1>mine solves 75&nbsp;% of L1 episodes (2 tasks)</h1>" in text


def test_names_and_reasons_are_escaped(text):
    assert "stack<b>" not in text.replace("&lt;", "")
    assert "stack&lt;b&gt;" in text
    assert "object &lt;6&gt; left" in text


def test_failure_causes_are_counted_over_tasks(text):
    rows = [[cell.strip() for cell in row] for row in Page(text).tables[1]]
    assert ["mine", "object left the workspace", "12", "40.0 %", "rotate 8, stack<b> 4"] in rows
    assert ["oracle", "every episode was solved"] in rows


def test_versions_levels_and_the_command_are_named(text):
    assert "openvima <b>9.8.7</b>" in text
    assert "abababababab" in text
    assert "--policy mine=RUN,oracle,random --tasks all --levels L1,L3 --episodes 10" in text
    assert all(f"<dt>{level} · " in text for level in ("L1", "L2", "L3", "L4"))


def test_the_page_suits_phones_and_dark_screens(text):
    assert '<meta name="viewport" content="width=device-width, initial-scale=1">' in text
    assert "@media (prefers-color-scheme: dark)" in text
    assert ".scroll { overflow-x: auto;" in text


def test_charts_take_their_colours_from_the_page(text):
    charts = re.findall(r"<svg.*?</svg>", text, flags=re.DOTALL)
    assert len(charts) == 4  # two levels, losses, accuracy
    assert all("var(--" in chart for chart in charts)
    assert not re.search(r"(fill|stroke): #", "".join(charts))


def test_equal_results_give_equal_bytes(results, clip, metrics, tmp_path):
    paths = [write_report(results, tmp_path / name, metrics=metrics, clips=[clip]) for name in ("a", "b")]
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_results_without_films_and_training_make_a_report_without_those_sections(results, tmp_path):
    page = Page(write_report(results, tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "video" not in page.tags
    assert "training" not in page.ids


def test_a_policy_missing_on_a_task_leaves_an_empty_cell(results, tmp_path):
    fewer = Results(results.rows[1:], results.config, results.versions, results.policies)
    table = Page(write_report(fewer, tmp_path / "report.html").read_text(encoding="utf-8")).tables[0]
    rotate = next(row for row in table if row[0].strip() == "rotate")
    assert rotate[1].strip() == "–"


def test_seventeen_tasks_and_eight_policies_fit_in(tmp_path, results):
    row = results.rows[0]
    rows = tuple(
        type(row)(f"policy {p}", f"task_{t}", level, 1, row.outcomes)
        for p in range(8)
        for level in ("L1", "L2", "L3", "L4")
        for t in range(17)
    )
    page = Page(write_report(Results(rows), tmp_path / "report.html").read_text(encoding="utf-8"))
    assert len(page.tables[0]) == 1 + 4 * (1 + 17 + 1)


def test_films_are_kept_beside_the_results(clip, tmp_path):
    save_clips([clip], tmp_path)
    assert load_clips(tmp_path) == (clip,)
    assert (tmp_path / "videos" / clip.file_name).read_bytes() == clip.video


def test_no_films_are_no_error_but_lost_ones_are(clip, tmp_path):
    assert load_clips(tmp_path) == ()
    save_clips([clip], tmp_path)
    (tmp_path / "videos" / clip.file_name).unlink()
    with pytest.raises(DatasetError, match="is damaged"):
        load_clips(tmp_path)


def test_curves_are_grouped_by_kind(metrics):
    assert [(chart.title, list(chart.curves)) for chart in read_charts(metrics)] == [
        ("Training: loss", ["training data", "held out"]),
        ("Training: accuracy", ["training data"]),
    ]


def test_stages_have_charts_of_their_own_and_many_curves_are_thinned(tmp_path):
    kinds = ("accuracy", "pick_accuracy", "yaw_accuracy")
    lines = [
        {"step": 5, "name": "1-matching", "loss": 2.0, "stage": 0},
        {"step": 5, "name": "cloning", **dict.fromkeys(kinds, 0.5)},
        {"step": 5, "name": "cloning", **{f"validation_{kind}": 0.4 for kind in kinds}},
    ]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    matching, cloning = read_charts(path)
    assert (matching.title, matching.curves) == ("Matching: loss", {"training data": [(5.0, 2.0)]})
    assert list(cloning.curves) == ["held out", "pick, held out", "yaw, held out"]


def test_a_damaged_training_record_names_the_line(tmp_path):
    (tmp_path / "metrics.jsonl").write_text('{"step": 1, "loss": 2}\n{"loss": 1}\n')
    with pytest.raises(DatasetError, match="line 2"):
        read_charts(tmp_path / "metrics.jsonl")
