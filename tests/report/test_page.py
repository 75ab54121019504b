"""The report: whole in one file, right numbers, readable HTML."""

import json
import re
import shlex
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from openvima.errors import DatasetError
from openvima.evaluation.comparison import compare
from openvima.evaluation.results import POLICY_ERROR, EpisodeOutcome, Results, Row
from openvima.report import write_report
from openvima.report.curves import read_charts, read_run_charts
from openvima.report.page import default_command
from openvima.report.published import beside
from openvima.report.text import role
from openvima.video.encoder import load_clips, save_clips
from small_data_sets import outcomes

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
            self.tables[-1][-1][-1] += data.replace("\xa0", " ") + " "


@pytest.fixture(scope="module")
def metrics(tmp_path_factory):
    path = tmp_path_factory.mktemp("run") / "metrics.jsonl"
    values = [(i, 3.0 / (i + 1), i / 50) for i in range(50)]
    lines = [{"step": i, "loss": a, "validation_loss": 1.1 * a, "accuracy": b} for i, a, b in values]
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return path


@pytest.fixture(scope="module")
def text(results, clip, metrics) -> str:
    path = write_report(results, metrics.with_name("report.html"), runs=metrics, clips=[clip])
    return path.read_text(encoding="utf-8")


def test_the_page_is_well_formed_and_needs_nothing_from_elsewhere(text):
    page = Page(text)
    assert all(resource.startswith(("data:", "#")) for resource in page.resources)
    assert not re.search(r"https?://|@import|url\((?!#)", text)
    assert page.tags.count("script") == 1  # of the package itself
    assert {"video", "svg", "table", "img"} <= set(page.tags)
    assert text.startswith("<!DOCTYPE html>")
    assert len(page.ids) == len(set(page.ids))
    used = set(re.findall(r'url\(#([^)]+)\)|href="#([^"]+)"', text))
    assert {a or b for a, b in used} <= set(page.ids)


def test_the_table_shows_rates_intervals_and_counts(text):
    table = Page(text).tables[0]
    heads = [cell.split() for cell in table[0]]
    assert heads == [["task"], ["mine"], ["oracle"], ["random"], ["VIMA", "200M", "published", "elsewhere"]]
    rotate = next(row for row in table if row[0].strip() == "rotate")
    assert "90.0 %" in rotate[1] and "60–98 · 9/10" in rotate[1]
    assert "100.0 %" in rotate[2]
    mean = next(row for row in table if row[0].strip() == "mean of 2")
    assert "75.0 %" in mean[1]
    published = {row[0].strip(): row[-1].strip() for row in table[2:5]}  # of the same task only
    assert published == {"rotate": "99.5 %", "stack<b>": "–", "mean of 2": "–"}


def test_names_and_reasons_are_escaped(text):
    assert "stack<b>" not in text.replace("&lt;", "")
    assert "stack&lt;b&gt;" in text
    assert "object &lt;6&gt; left" in text
    assert "red &lt;swirl&gt; letter A) left the workspace" in text


def test_failure_causes_are_counted_over_tasks(text):
    rows = [[cell.strip() for cell in row] for row in Page(section(text, "failures")).tables[0]]
    assert ["mine", "object left the workspace", "12", "40.0 %", "rotate 8, stack<b> 4"] in rows
    assert ["oracle", "every episode was solved"] in rows


def section(text: str, name: str) -> str:
    found = re.search(rf'<section id="{name}">.*?</section>', text, flags=re.DOTALL)
    return found[0] if found else ""


def test_trained_policies_are_compared_unasked(text):
    comparison = section(text, "comparison")
    assert "<h3>mine against random</h3>" in comparison
    assert "On all levels together, mine is better than random: +56.7 points" in comparison
    table = Page(comparison).tables[1]
    stack = next(row for row in table if "stack<b>" in row[0])
    assert stack[1].split()[0] == "+50.0" and stack[5].strip() == "5 : 0"


def test_a_difference_that_is_not_significant_is_said_to_be_so(results, tmp_path):
    mine = [row for row in results.rows if row.policy == "mine"]
    worse = replace(mine[0], outcomes=outcomes(mine[0].successes - 1))
    twin = tuple(replace(row, policy="twin") for row in (worse, *mine[1:]))
    both = replace(results, rows=(*results.rows, *twin))
    path = write_report(both, tmp_path / "a.html", comparisons=[compare(both, "twin", "mine")])
    comparison = section(path.read_text(encoding="utf-8"), "comparison")
    assert "On all levels together, twin − mine is −" in comparison  # as the table has it
    assert comparison.count("≈ not significant") == 6  # three tasks, two levels, all


def test_ablations_stand_beside_the_score(results, tmp_path):
    rows = [row for row in results.rows if row.policy == "mine"]
    without = (replace(r, ablation="no_prompt", outcomes=outcomes(r.successes - 3)) for r in rows)
    named = (replace(r, ablation="somebody_elses", outcomes=r.outcomes[:4]) for r in rows)
    path = write_report(replace(results, rows=(*results.rows, *without, *named)), tmp_path / "a.html")
    text = path.read_text(encoding="utf-8")
    ablations = section(text, "ablations")
    table = Page(ablations).tables[0]
    heads = [cell.strip() for cell in table[0]]
    assert heads == ["level", "mine", "no prompt", "somebody elses"]
    assert "75.0 %" in table[1][1] and "45.0 %" in table[1][2]
    # and nothing else on the page changes
    plain = write_report(results, tmp_path / "b.html").read_text(encoding="utf-8")
    for name in ("overview", "results", "failures", "comparison", "published"):
        assert section(text, name) == section(plain, name)
    assert not section(plain, "ablations")


def rows_of_all_tasks(results, level):
    """Rows as if a policy had been evaluated on all tasks of a level."""
    return tuple(replace(results.rows[0], task=task, level=level) for task in beside().tasks[level])


def test_published_means_are_those_of_the_same_tasks(text, results, tmp_path):
    published = section(text, "published")
    assert "not measured here" in published and "read off figures" in published
    rows = {row[0].split()[0]: row for row in Page(published).tables[0][1:]}
    assert [cell.strip() for cell in rows["VIMA"][1:]] == ["–", "100.0"]  # a task of one's own; rotate alone
    assert "MIDAS" not in rows  # its rates by task were not published

    whole = replace(results, rows=rows_of_all_tasks(results, "L1"))
    page = section(write_report(whole, tmp_path / "whole.html").read_text("utf-8"), "published")
    rows = {row[0].split()[0]: row for row in Page(page).tables[0][1:]}
    assert "over the same tasks." in page
    assert rows["VIMA"][1].strip() == "81.5"
    assert rows["MIDAS"][1].strip() == "91.6"  # the last of that name: without pretraining
    text = write_report(whole, tmp_path / "bare.html", with_published=False).read_text("utf-8")
    assert "VIMA 200M" not in text and "published" not in section(text, "results")


def test_code_is_hashed_as_source_and_weights_as_weights(results, tmp_path):
    kinds = {name: {"kind": "random"} for name in results.policies}
    first, second = list(kinds)[:2]
    kinds[first] = {"kind": "code", "source": "p.py:make", "sha256": "a" * 64, "weights_sha256": "b" * 64}
    kinds[second] = {"kind": "run", "sha256": "c" * 64}
    text = write_report(replace(results, policies=kinds), tmp_path / "a.html").read_text("utf-8")
    assert f"{first} source <b>{'a' * 12}</b>" in text
    assert f"{first} weights <b>{'b' * 12}</b>" in text
    assert f"{second} weights <b>{'c' * 12}</b>" in text


def test_tables_are_marked_if_all_outcomes_were_confirmed_by_replay(results, tmp_path):
    text = write_report(results, tmp_path / "a.html", confirmations={"my run": True}).read_text("utf-8")
    assert all(
        "confirmed by replay</a>" in section(text, name) for name in ("overview", "results", "families")
    )
    assert not any("confirmed by replay</a>" in section(text, name) for name in ("published", "failures"))
    said = section(text, "verification")
    assert "who acted (policies)" in said and "claim until openvima verify-results &#39;my run&#39;" in said

    both = {"my run": True, "b": False}
    text = write_report(results, tmp_path / "b.html", confirmations=both).read_text("utf-8")
    assert "confirmed by replay</a>" not in text
    assert "Not confirmed by replay. openvima verify-results b plays" in section(text, "verification")


def test_settings_other_than_the_usual_ones_are_stated_at_the_top(results, tmp_path):
    settings = {"prompts": "text", "task_options": "num_distractors=3", "assets": "original", "compat": True}
    other = replace(results, config={**results.config, **settings})
    top = write_report(other, tmp_path / "a.html").read_text("utf-8").split("<main>")[0]
    assert "Prompts: text. Task options: num_distractors=3. Assets: original. Compat: True." in top


def test_errors_of_policies_are_counted_for_each_policy_that_has_any(tmp_path):
    bad = EpisodeOutcome(7, False, 1, "mine raised <it>.", POLICY_ERROR)
    path = write_report(Results((Row("mine", "rotate", "L1", 1, (bad, bad)),)), tmp_path / "a.html")
    text = section(path.read_text(encoding="utf-8"), "failures")
    assert (
        "2 of 2 episodes of mine ended by an error of the policy; first in rotate, L1, seed 7: mine" in text
    )
    assert "&lt;it&gt;" in text


def test_an_index_of_videos_that_others_wrote_reads_no_other_file(clip, tmp_path):
    save_clips([replace(clip, policy="mine")], tmp_path)
    index = tmp_path / "videos" / "clips.json"
    record = json.loads(index.read_text())
    (tmp_path / "secret_rotate_L1_9.mp4").write_bytes(b"elsewhere")
    outside = json.dumps([record[0] | {"policy": "../secret"}])
    for content in (outside, '["x"]', '{"a": 1}', "[null]", "[" * 100_000):
        index.write_text(content)
        with pytest.raises(DatasetError, match=r"clips\.json is damaged"):
            load_clips(tmp_path)


def test_stages_have_charts_of_their_own_and_many_curves_are_thinned(tmp_path):
    kinds = ("accuracy", "pick_accuracy", "yaw_accuracy")
    lines = [
        {"step": 5, "name": "1-pretraining", "loss": 2.0, "loss/contrastive": 1.5, "stage": 0},
        {"step": 5, "name": "cloning", **dict.fromkeys(kinds, 0.5)},
        {"step": 5, "name": "cloning", **{f"validation_{kind}": 0.4 for kind in kinds}},
    ]
    path = tmp_path / "metrics.jsonl"
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    matching, cloning = read_charts(path)
    losses = {"training data": [(5.0, 2.0)], "contrastive, training data": [(5.0, 1.5)]}
    assert (matching.title, matching.curves) == ("Pretraining: loss", losses)
    assert list(cloning.curves) == ["held out", "pick, held out", "yaw, held out"]


def test_curves_of_several_runs_are_told_apart_by_their_titles(metrics, tmp_path):
    runs = [tmp_path / "runs" / name for name in ("one", "two")]
    for run in runs:
        run.mkdir(parents=True)
        (run / "metrics.jsonl").write_bytes(metrics.read_bytes())
    titles = [chart.title for chart in read_run_charts(runs)]
    assert titles == [f"{run} · Training: {kind}" for run in ("one", "two") for kind in ("loss", "accuracy")]
    assert read_run_charts([runs[0]]) == read_charts(metrics)


@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe\x00",
        b'{"step": 1, "loss": ' + b"9" * 400 + b"}",
        b'{"step": ' + b"9" * 400 + b"}",
        b"[" * 10**5,
    ],
)
def test_a_training_record_of_other_content_is_refused(tmp_path, content):
    (tmp_path / "metrics.jsonl").write_bytes(content)
    with pytest.raises(DatasetError, match=r"metrics\.jsonl"):
        read_charts(tmp_path / "metrics.jsonl")


def test_the_command_of_results_that_others_wrote_runs_nothing_else(results):
    hostile = "$(id); rm -rf ~"
    names = {"tasks": [hostile], "levels": [hostile], "ablations": [hostile]}
    config = {**results.config, **names, "episodes": hostile, "seed": hostile}
    words = shlex.split(default_command(replace(results, config=config)))
    options = ("--tasks", "--levels", "--ablations", "--episodes", "--seed")
    assert [words[words.index(option) + 1] for option in options] == [hostile] * 5
    assert words.count(hostile) == 5


@pytest.mark.parametrize(
    ("record", "sentence"),
    [
        ({"kind": "remote", "metadata": {"modalities": ["rgb", "joints"]}}, " It got no segmentation."),
        ({"kind": "remote", "metadata": {}}, "two camera images."),
        ({"kind": "object", "modalities": ["rgb", "segm"]}, " The segmentation was sent to it."),
        (
            {"kind": "run", "excluded_tasks": ["follow_order", "twist"]},
            " Trained without follow_order, twist.",
        ),
    ],
)
def test_a_policy_is_described_with_what_it_did_not_get(results, record, sentence) -> None:
    assert role(replace(results, policies={"mine": record}), "mine").endswith(sentence)


def test_all_episodes_are_listed_failures_first_and_lead_to_their_videos(text):
    rows = [[cell.strip() for cell in row] for row in Page(section(text, "episodes")).tables[0]]
    assert rows[0] == ["policy", "level", "task", "seed", "outcome", "steps", "reason"]
    assert len(rows) == 1 + 90
    reason = "object 6 (red <swirl> letter A) left the workspace"
    assert rows[1] == ["mine", "L1", "rotate", "▶ 9", "failed", "2", reason]
    assert rows[-1] == ["random", "L1", "stack<b>", "0", "solved", "2", ""]
    assert 'data-value="object left the workspace"' in section(text, "episodes")
    assert '<a href="#mine/rotate/L1/9">' in text
    assert 'id="mine/rotate/L1/9"' in section(text, "videos")


def test_of_very_many_episodes_the_first_failures_are_listed(results, tmp_path, monkeypatch):
    monkeypatch.setattr("openvima.report.page.MOST_EPISODES", 40)
    text = write_report(results, tmp_path / "a.html").read_text(encoding="utf-8")
    listed = section(text, "episodes")
    assert "failures first: 40 of 90 episodes" in listed and ">solved<" not in listed


@pytest.mark.slow
def test_a_browser_sorts_filters_and_unfolds(text, tmp_path, browser):
    path = tmp_path / "report.html"
    path.write_text(text, encoding="utf-8")
    page = browser.new_page(viewport={"width": 400, "height": 800})
    page.goto(path.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == 400

    page.locator(".contents a[href='#episodes']").click()
    page.locator("#episodes summary").click()
    page.locator(".filters select").nth(0).select_option("mine")
    page.locator(".filters select").nth(3).select_option("failed")
    assert page.locator(".filters output").inner_text() == "12 of 90 episodes"
    assert page.locator("#episodes tbody tr:visible").count() == 12

    seeds = page.locator("#episodes tbody tr:visible td:nth-child(4)")
    head = page.locator("#episodes thead button").nth(3)
    for order in (sorted, lambda values: sorted(values, reverse=True)):
        head.click()
        found = [int(seed.replace("▶", "")) for seed in seeds.all_inner_texts()]
        assert found == order(found) and len(set(found)) > 3

    page.locator("#results thead button").nth(1).click()
    names = page.locator("#results tbody").nth(0).locator("th").all_inner_texts()
    assert [name.split()[0] for name in names] == ["L1", "stack<b>", "rotate", "mean", "mean"]
    page.close()
