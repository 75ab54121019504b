"""Report assets: which episodes are recorded, and the whole way to the report."""

from dataclasses import replace

import pytest

from openvima.cli.main import main
from openvima.errors import ConfigError, MissingExtraError
from openvima.evaluation import EvaluationConfig, Results
from openvima.evaluation.sources import PolicySource
from openvima.report import VideoSelection, evaluate_and_report
from openvima.report import videos as report_videos
from openvima.report.page import default_command
from openvima.video.encoder import load_clips
from small_data_sets import contents


def test_solved_episodes_are_recorded_and_failures_of_trained_policies_too(results):
    config = EvaluationConfig(("mine=runs/a", "oracle", "random"))
    batches = report_videos.recordings(config, VideoSelection(2), results)
    recorded = [(batch.policy, batch.task, batch.level, batch.first_seed) for batch in batches]
    assert sorted(recorded) == [
        *(("mine", "rotate", "L1", seed) for seed in (0, 1, 9)),
        *(("mine", "rotate", "L3", seed) for seed in (0, 1, 3, 4)),
        *(("mine", "stack<b>", "L1", seed) for seed in (0, 1, 6, 7)),
        *(("oracle", "rotate", "L1", seed) for seed in (0, 1)),
        *(("oracle", "stack<b>", "L1", seed) for seed in (0, 1)),
    ]
    assert {batch.source for batch in batches} == {"runs/a", "oracle"}
    assert all(batch.episodes == 1 for batch in batches)


def test_failures_are_recorded_first_and_within_a_budget(results, monkeypatch):
    monkeypatch.setattr(report_videos, "MOST_VIDEOS", 4)
    config = EvaluationConfig(("mine=runs/a", "oracle"))
    batches = report_videos.recordings(config, VideoSelection(), results)
    assert [batch.episode for batch in batches] == [
        *(("mine", *cell) for cell in (("rotate", "L1", 9), ("rotate", "L3", 3), ("stack<b>", "L1", 6))),
        ("mine", "rotate", "L1", 0),
    ]


def test_the_table_is_printed_before_any_video(tmp_path, monkeypatch, capsys):
    printed = []

    def record(*_) -> list:
        printed.append(capsys.readouterr().out)
        return []

    monkeypatch.setattr(report_videos, "_recorded", record)
    words = "evaluate --policy oracle --tasks rotate --levels L1 --episodes 1 --workers 1 --out"
    assert main([*words.split(), str(tmp_path / "out")]) == 0
    assert "Success rates" in printed[0] and "100.0" in printed[0]


def test_without_trained_policies_all_are_recorded_and_none_unless_requested(results):
    assert report_videos.recordings(EvaluationConfig(("oracle",)), VideoSelection(0), results) == []
    batches = report_videos.recordings(EvaluationConfig(("random",)), VideoSelection(), results)
    assert {batch.policy for batch in batches} == {"random"}


def test_requested_episodes_are_recorded_of_every_policy(results):
    settings = {"tasks": ("rotate",), "levels": ("L1", "L3"), "episodes": 10}
    config = EvaluationConfig(("mine=runs/a", "oracle"), **settings)
    videos = VideoSelection(0, ("rotate/4", "rotate/L3/5"))
    assert [batch.episode for batch in report_videos.recordings(config, videos, results)] == [
        *(("mine", "rotate", level, seed) for level, seed in (("L1", 4), ("L3", 5))),
        *(("oracle", "rotate", level, seed) for level, seed in (("L1", 4), ("L3", 5))),
    ]


@pytest.mark.parametrize("text", ["rotate", "rotate/L1", "rotate/10", "twist/3", "rotate/L2/3", "rotate/-1"])
def test_requested_episodes_outside_the_evaluation_are_refused(text):
    config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=10)
    with pytest.raises(ConfigError, match=f"record_video is '{text}'"):
        report_videos.requested_episodes(config, VideoSelection(record_video=(text,)))


def test_further_videos_are_added_to_those_recorded_before(tmp_path):
    config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=2, out=tmp_path)
    notes = []
    evaluate_and_report(config, VideoSelection(0, ("rotate/1",)))
    evaluate_and_report(
        config, VideoSelection(0, ("rotate/0",)), lambda done, total, note: notes.append(note)
    )
    assert notes == ["recorded 1 of 1 (--videos 0: none)"]
    assert [clip.seed for clip in load_clips(tmp_path)] == [0, 1]


def test_the_command_names_run_folders_and_what_differs_from_the_defaults():
    config = EvaluationConfig(
        ("mine=my runs/a", "oracle"), ("rotate",), ("L1", "L2"), episodes=7, seed=3, batch=4
    )
    assert default_command(Results((), config.record()), config.policies) == (
        "openvima evaluate --policy 'mine=my runs/a,oracle' --tasks rotate --levels L1,L2 --episodes 7 "
        "--seed 3 --batch 4 --out DIR"
    )


def test_training_curves_are_those_of_the_first_trained_policy(tmp_path):
    (tmp_path / "metrics.jsonl").write_text("")
    oracle = PolicySource("oracle", "oracle")
    run = PolicySource("mine", str(tmp_path))
    checkpoint = PolicySource("mine", str(tmp_path / "checkpoints" / "step-1"))
    assert report_videos.find_metrics([oracle, run]) == [tmp_path / "metrics.jsonl"]
    assert report_videos.find_metrics([checkpoint]) == [tmp_path / "metrics.jsonl"]
    assert report_videos.find_metrics([oracle]) == []


def test_a_missing_extra_is_named_before_any_episode(tmp_path, monkeypatch):
    monkeypatch.setattr(
        report_videos.importlib.util, "find_spec", lambda name: None if name == "av" else object()
    )
    with pytest.raises(MissingExtraError, match=r"needs av; install with: pip install 'openvima\[report\]'"):
        evaluate_and_report(EvaluationConfig(("oracle",), out=tmp_path / "new"))
    assert not (tmp_path / "new").exists()


def test_an_evaluation_leaves_results_videos_and_a_report(tmp_path):
    config = EvaluationConfig(("oracle",), ("rotate",), ("L1",), episodes=2, out=tmp_path / "first")
    notes = []
    path = evaluate_and_report(config, progress=lambda done, total, note: notes.append(note))
    folder = path.parent
    assert sorted(file.name for file in folder.iterdir()) == [
        "actions.arrow",
        "evaluation_log.json",
        "report.html",
        "results.json",
        "videos",
    ]
    assert notes[-1].startswith("recorded 1 of 1")
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.count("<video") == 1 and "✓ solved in 1 step" in page
    second = evaluate_and_report(replace(config, out=tmp_path / "second")).parent
    assert {
        name for name, content in contents(folder).items() if (second / name).read_bytes() != content
    } <= {"evaluation_log.json"}
