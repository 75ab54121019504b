"""The verb `report`: pages and tables of one or several evaluations."""

import json

import pytest

from openvima.cli.main import main
from openvima.evaluation import EvaluationConfig, evaluate
from openvima.evaluation.results import EpisodeOutcome, Results, Row
from openvima.evaluation.verification import verify_results


def evaluation(solved: int) -> Results:
    """A policy `mine` that solves so many of 20 episodes, beside the oracle."""
    rows = tuple(
        Row(name, "rotate", "L1", 3, tuple(EpisodeOutcome(i, i < number, 1, "", "") for i in range(20)))
        for name, number in (("mine", solved), ("oracle", 20))
    )
    policies = {"mine": {"kind": "run", "sha256": f"{solved:064}"}, "oracle": {"kind": "oracle"}}
    return Results(rows, {"tasks": ["rotate"], "episodes": 20}, {"openvima": "1"}, policies)


@pytest.fixture
def folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, solved in (("first", 5), ("second", 15)):
        evaluation(solved).write(tmp_path / name / "results.json")
    return tmp_path


def test_several_evaluations_make_one_page_and_leave_theirs_alone(folders, capsys):
    assert main(["report", "first", "second/results.json", "--compare", "mine@second,mine@first,oracle"]) == 0
    said = capsys.readouterr().out
    assert "On L1, mine@second is better than mine@first: +50.0 points" in said
    assert "On L1, oracle is better than mine@second" in said
    page = (folders / "report.html").read_text(encoding="utf-8")
    assert "mine@second against mine@first" in page
    assert page.count("openvima evaluate --policy mine=RUN,oracle") == 2
    assert not (folders / "first" / "report.html").exists()


@pytest.mark.parametrize(("name", "sign"), [("table.md", "| policy | L1 |"), ("table.tex", "\\toprule")])
def test_the_ending_of_the_file_decides_what_is_written(folders, name, sign):
    assert main(["report", "first", "--out", f"paper/{name}"]) == 0
    assert sign in (folders / "paper" / name).read_text(encoding="utf-8")


def test_another_file_of_a_confirmed_folder_is_not_called_confirmed(tmp_path):
    evaluate(EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=1, out=tmp_path))
    verify_results(tmp_path)
    text = (tmp_path / "results.json").read_text()
    (tmp_path / "best.json").write_text(text.replace('"steps": 1', '"steps": 2'))
    shown = {}
    for name in ("results.json", "best.json"):
        assert main(["report", str(tmp_path / name), "--out", str(tmp_path / "table.md")]) == 0
        shown[name] = "outcomes are confirmed by replay" in (tmp_path / "table.md").read_text()
    assert shown == {"results.json": True, "best.json": False}


def test_comparisons_are_printed_as_json(folders, capsys):
    assert main(["report", "first", "second", "--json", "--compare", "mine@first,mine@second"]) == 0
    comparison = json.loads(capsys.readouterr().out)[0]
    assert (comparison["a"], comparison["b"]) == ("mine@first", "mine@second")
    assert comparison["overall"]["verdict"] == "b"


def test_learning_curves_of_runs_are_shown(folders):
    (folders / "run").mkdir()
    (folders / "run" / "metrics.jsonl").write_text('{"step": 1, "loss": 2.0}\n{"step": 2, "loss": 1.0}\n')
    assert main(["report", "first", "--runs", "run", "--out", "page.html"]) == 0
    assert '<section id="training">' in (folders / "page.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "at least one folder"),
        (["first", "--out", "page.pdf"], ".md or .tex"),
        (["first", "--compare", "mine"], "two or more policies"),
        (["first", "--compare", "mine,oracel"], "Did you mean 'oracle'?"),
        (["first", "--runs", "first"], "give the folder of a training run"),
        (["third"], "there is no third"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(folders, words, message, capsys):
    assert main(["report", *words]) == 2
    error = capsys.readouterr().err.strip()
    assert message in error.splitlines()[-1]
    assert not list(folders.glob("**/*.html"))
