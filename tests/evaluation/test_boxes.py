"""Detectors that are plugged in for the ablation `detected_boxes`."""

from dataclasses import replace
from pathlib import Path

import pytest

from openvima.errors import ConfigError
from openvima.evaluation import EvaluationConfig, Results, evaluate, runner

EXTRACTORS = Path(__file__).parents[1] / "plugged_extractors.py"
CONFIG = EvaluationConfig(
    ("untrained",),
    ("visual_manipulation",),
    ("L1",),
    episodes=2,
    ablations=("detected_boxes",),
    boxes="x:y",
)


@pytest.fixture
def rows(tmp_path: Path):
    """Play with a detector; returns the plain outcomes and those with its boxes."""
    pytest.importorskip("torch")

    def played(boxes: str):
        results = Results.read(evaluate(replace(CONFIG, boxes=boxes, out=tmp_path / "out")))
        return [row.outcomes for row in results.rows]

    return played


def test_a_detector_that_finds_what_the_segmentation_says_changes_nothing(rows):
    plain, detected = rows(f"{EXTRACTORS}:truth")
    assert detected == plain


def test_a_detector_that_finds_nothing_fails_its_episodes_and_stops_nobody(rows):
    _, detected = rows(f"{EXTRACTORS}:Blind")
    assert [outcome.success for outcome in detected] == [False, False]


def test_a_missing_detector_is_named_before_anything_is_played(tmp_path):
    with pytest.raises(ConfigError, match="no such module"):
        evaluate(replace(CONFIG, boxes="no_such_module:make", out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_an_edited_detector_plays_its_batches_again_and_no_others(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    file, played = tmp_path / "mine.py", []
    file.write_text("from plugged_extractors import truth as make")
    config = replace(CONFIG, boxes=f"{file}:make", out=tmp_path / "out", episodes=1)
    play_batch = runner.play_batch

    def noting(job, count):
        played.append(job.batch.ablation)
        return play_batch(job, count)

    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(runner, "play_batch", noting)
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(runner, "write_actions", interrupted)
        evaluate(config)
    file.write_text("from plugged_extractors import Blind as make")
    rows = Results.read(evaluate(config)).rows
    assert played == ["", "detected_boxes", "detected_boxes"]
    assert [row.outcomes[0].success for row in rows] == [rows[0].outcomes[0].success, False]
    file.write_text("from plugged_extractors import truth as make")
    with pytest.raises(ConfigError, match="holds another evaluation"):
        evaluate(config)
