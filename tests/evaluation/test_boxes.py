"""Detectors that are plugged in for the ablation `detected_boxes`."""

from dataclasses import replace
from pathlib import Path

import pytest

from openvima.errors import ConfigError
from openvima.evaluation import EvaluationConfig, Results, evaluate

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
