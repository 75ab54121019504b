"""Detectors that are plugged in for the control `detected_boxes`."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from openvima.env import TabletopEnv
from openvima.errors import CheckpointError, ConfigError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.boxes import load_finder
from openvima.perception.objects import GROUND_TRUTH, GroundTruth

CONFIG = EvaluationConfig(
    ("untrained",),
    ("visual_manipulation",),
    ("L1",),
    episodes=2,
    report=False,
    controls=("detected_boxes",),
    boxes="x:y",
)
FINDERS = """
from openvima.perception.objects import GROUND_TRUTH, see_nothing

def truth():
    return GROUND_TRUTH

class Blind:
    def in_observation(self, observation):
        return see_nothing()

    def in_prompt_image(self, image):
        return see_nothing()
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "finders.py"
    path.write_text(FINDERS)
    return path


@pytest.fixture
def rows(tmp_path: Path):
    """Play with a detector; returns the plain outcomes and those with its boxes."""
    pytest.importorskip("torch")

    def played(boxes: str):
        results = Results.read(evaluate(replace(CONFIG, boxes=boxes, out=tmp_path / "out")))
        return [row.outcomes for row in results.rows]

    return played


def test_a_detector_that_finds_what_the_segmentation_says_changes_nothing(file, rows):
    plain, detected = rows(f"{file}:truth")
    assert detected == plain


def test_a_detector_that_finds_nothing_fails_its_episodes_and_stops_nobody(file, rows):
    _, detected = rows(f"{file}:Blind")
    assert [outcome.success for outcome in detected] == [False, False]


def test_a_detector_of_a_module_is_found_by_name(file, monkeypatch):
    monkeypatch.syspath_prepend(str(file.parent))
    finder = load_finder("finders:truth")
    sys.modules.pop("finders")
    assert finder.finder == GROUND_TRUTH


def test_where_something_is_found_it_is_left_as_it_is():
    finder = load_finder("openvima.perception.objects:GroundTruth")
    assert finder.finder == GroundTruth()
    env = TabletopEnv("rotate", level="L1")
    observation, _ = env.reset(seed=0)
    assert np.array_equal(
        finder.in_observation(observation).ids, GroundTruth().in_observation(observation).ids
    )


@pytest.mark.parametrize(
    ("hook", "message"),
    [
        ("finder", "MODULE:FUNCTION"),
        ("no_such_module:make", "cannot be imported"),
        ("no/such/file.py:make", "cannot be imported"),
        ("openvima.perception.objects:make", "has no function 'make'"),
        ("builtins:dict", "gave a dict"),
    ],
)
def test_what_makes_no_detector_is_named(hook, message):
    with pytest.raises(ConfigError, match=message):
        load_finder(hook)


def test_a_trained_detector_is_found_by_its_folder(tmp_path):
    pytest.importorskip("torch")
    with pytest.raises(CheckpointError, match="no folder"):
        load_finder(f"detector={tmp_path / 'none'}")
    with pytest.raises(CheckpointError, match="no checkpoint"):
        load_finder(f"detector={tmp_path}")


def test_a_missing_detector_is_named_before_anything_is_played(tmp_path):
    with pytest.raises(ConfigError, match="cannot be imported"):
        evaluate(replace(CONFIG, boxes="no_such_module:make", out=tmp_path / "out"))
    assert not (tmp_path / "out").exists()
