"""A study end to end: interrupted, resumed, extended by a seed; folders of other studies are refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("matplotlib")

from openvima.atomic_io import folder_lock
from openvima.errors import ConfigError, FolderLockedError
from openvima.studies import (
    Demonstrations,
    EvaluationSettings,
    Run,
    Study,
    StudyInputs,
    run_study,
    scale_named,
)

INPUTS = StudyInputs(scale_named("nano"))
STUDY = Study(
    "test",
    "Does it resume?",
    "fraction",
    (Run("all", init={"schedule.steps": 1}), Run("half", data_fraction=0.5)),
    EvaluationSettings(("rotate",), ("L1",), 1),
    Demonstrations(("rotate",), 2),
    {
        "preset": "midas-nano",
        "schedule.steps": 2,
        "schedule.checkpoint_every": 1,
        "loader.validation_fraction": 0.0,
    },
)


def points(folder: Path) -> list:
    return json.loads((folder / "study.json").read_text(encoding="utf-8"))["points"]


class Interrupted(BaseException):
    """Stands for Ctrl-C, at a stage."""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::openvima.errors.UnknownWordWarning")  # of words beyond these few
def test_an_interrupted_study_ends_with_the_same_points(tmp_path: Path) -> None:
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    page = run_study(STUDY, INPUTS, whole)
    assert "Does it resume?" in page.read_text(encoding="utf-8")
    for stage in (2, 4):

        def interrupt(done: int, total: int, note: str, at: int = stage) -> None:
            if done == at and ":" in note:  # amid a training
                raise Interrupted

        with pytest.raises(Interrupted):
            run_study(STUDY, INPUTS, resumed, report=interrupt)
        assert not (resumed / "study.json").exists()
    run_study(STUDY, INPUTS, resumed)
    assert points(resumed) == points(whole)
    costs = json.loads((resumed / "study.json").read_text(encoding="utf-8"))["costs"]
    assert [cost["demonstrations"] for cost in (*costs["all"], *costs["half"])] == [2, 1]


def test_a_folder_of_another_study_or_of_another_process_is_refused(tmp_path: Path) -> None:
    study = replace(STUDY, runs=(Run("oracle", policy="oracle"),))
    run_study(study, INPUTS, tmp_path)
    with pytest.raises(ConfigError, match=r"evaluation\.episodes is 1 there and 2 here"):
        run_study(replace(study, evaluation=replace(study.evaluation, episodes=2)), INPUTS, tmp_path)
    with folder_lock(tmp_path), pytest.raises(FolderLockedError):
        run_study(study, INPUTS, tmp_path)
