"""What follows the results: which episodes are filmed, and the whole way to the report."""

from dataclasses import replace
from pathlib import Path

import pytest

from openvima.errors import ConfigError, MissingExtraError
from openvima.evaluation import EvaluationConfig, evaluate, report_assets
from openvima.evaluation.clips import load_clips
from openvima.evaluation.sources import PolicySource


def test_solved_episodes_are_filmed_and_of_trained_policies_unsolved_ones_too(results, monkeypatch):
    config = EvaluationConfig(("mine=runs/a", "oracle", "random"), videos=2)
    jobs = report_assets.recording_jobs(config, results)
    filmed = [(job.batch.policy, job.batch.task, job.batch.level, job.batch.first_seed) for job in jobs]
    assert filmed == [
        *(("mine", "rotate", "L1", seed) for seed in (0, 1, 9)),
        *(("mine", "stack<b>", "L1", seed) for seed in (0, 1, 6, 7)),
        *(("oracle", "rotate", "L1", seed) for seed in (0, 1)),
        *(("oracle", "stack<b>", "L1", seed) for seed in (0, 1)),
    ]
    assert {job.batch.source for job in jobs} == {"runs/a", "oracle"}
    assert all(job.batch.episodes == 1 for job in jobs)


def test_where_nobody_is_trained_all_are_filmed(results):
    jobs = report_assets.recording_jobs(EvaluationConfig(("random",)), results)
    assert {job.batch.policy for job in jobs} == {"random"}


def test_no_films_are_made_where_none_are_asked_for(results):
    assert report_assets.recording_jobs(EvaluationConfig(("oracle",), videos=0), results) == []


def test_episodes_chosen_by_name_are_filmed_of_every_policy(results):
    settings = {"tasks": ("rotate",), "levels": ("L1", "L3"), "episodes": 10}
    config = EvaluationConfig(
        ("mine=runs/a", "oracle"), **settings, videos=0, film=("rotate/4", "rotate/L3/5")
    )
    assert [job.episode for job in report_assets.recording_jobs(config, results)] == [
        *(("mine", "rotate", level, seed) for level, seed in (("L1", 4), ("L3", 5))),
        *(("oracle", "rotate", level, seed) for level, seed in (("L1", 4), ("L3", 5))),
    ]


@pytest.mark.parametrize("text", ["rotate", "rotate/L1", "rotate/10", "twist/3", "rotate/L2/3", "rotate/-1"])
def test_episodes_to_film_that_are_not_played_are_refused(text):
    config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=10, film=(text,))
    with pytest.raises(ConfigError, match=f"film is '{text}'"):
        report_assets.requested_episodes(config)


def test_films_of_more_episodes_are_added_to_those_that_are_there(tmp_path):
    config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=2, out=tmp_path, videos=0)
    notes = []
    evaluate(replace(config, film=("rotate/1",)))
    evaluate(replace(config, film=("rotate/0",)), lambda done, total, note: notes.append(note))
    assert notes == ["filmed 1 of 1"]
    assert [clip.seed for clip in load_clips(tmp_path)] == [0, 1]


def test_the_command_names_run_folders_and_what_differs_from_the_defaults():
    config = EvaluationConfig(
        ("mine=my runs/a", "oracle"), ("rotate",), ("L1", "L2"), episodes=7, seed=3, batch=4
    )
    assert report_assets.command_of(config) == (
        "openvima evaluate --policy 'mine=my runs/a,oracle' --tasks rotate --levels L1,L2 --episodes 7 "
        "--seed 3 --batch 4 --out DIR"
    )


def test_training_curves_are_those_of_the_first_trained_policy(tmp_path):
    (tmp_path / "metrics.jsonl").write_text("")
    oracle = PolicySource("oracle", "oracle")
    run = PolicySource("mine", str(tmp_path))
    checkpoint = PolicySource("mine", str(tmp_path / "checkpoints" / "step-1"))
    assert report_assets.find_metrics([oracle, run]) == tmp_path / "metrics.jsonl"
    assert report_assets.find_metrics([checkpoint]) == tmp_path / "metrics.jsonl"
    assert report_assets.find_metrics([oracle]) is None


def test_a_missing_extra_is_named_before_anything_is_played(tmp_path, monkeypatch):
    monkeypatch.setattr(
        report_assets.importlib.util, "find_spec", lambda name: None if name == "av" else object()
    )
    with pytest.raises(MissingExtraError, match=r"needs av; install with: pip install 'openvima\[report\]'"):
        evaluate(EvaluationConfig(("oracle",), out=tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_an_evaluation_leaves_results_films_and_a_report(tmp_path):
    config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=2, out=tmp_path / "first")
    notes = []
    path = evaluate(config, lambda done, total, note: notes.append(note))
    folder = path.parent
    assert sorted(file.name for file in folder.iterdir()) == [
        "evaluation_log.json",
        "report.html",
        "results.json",
        "videos",
    ]
    assert notes[-1] == "filmed 1 of 1"
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.count("<video") == 1 and "✓ solved in 1 step" in page
    assert contents(folder) == contents(evaluate(replace(config, out=tmp_path / "second")).parent)


def contents(folder: Path) -> dict[str, bytes]:
    """All that must not depend on time or machine."""
    files = (file for file in folder.rglob("*") if file.is_file() and "log" not in file.name)
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}
