"""Detectors named in a word: how they are found, named and made into tokens."""

import sys
from pathlib import Path

import numpy as np
import pytest

from openvima.detection.hooks import plugged_finder
from openvima.env import TabletopEnv
from openvima.errors import CheckpointError, ConfigError
from openvima.perception.objects import GROUND_TRUTH, GroundTruth

FINDERS = """
from openvima.perception.objects import GROUND_TRUTH, see_nothing

def truth():
    return GROUND_TRUTH

class Blind:
    def in_observation(self, observation):
        return see_nothing()

    def in_prompt_image(self, image):
        return see_nothing(2)
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "finders.py"
    path.write_text(FINDERS)
    return path


def test_a_detector_of_a_module_is_found_by_name(file, monkeypatch):
    monkeypatch.syspath_prepend(str(file.parent))
    finder = plugged_finder("finders:truth")
    sys.modules.pop("finders")
    assert finder.finder == GROUND_TRUTH


def test_where_something_is_found_it_is_left_as_it_is():
    finder = plugged_finder("openvima.perception.objects:GroundTruth")
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
        plugged_finder(hook)


def test_a_trained_detector_is_found_by_its_folder(tmp_path):
    pytest.importorskip("torch")
    with pytest.raises(CheckpointError, match="no folder"):
        plugged_finder(f"detector={tmp_path / 'none'}")
    with pytest.raises(CheckpointError, match="no checkpoint"):
        plugged_finder(f"detector={tmp_path}")
