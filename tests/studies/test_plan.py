"""Studies: stages, seeds, checks before any work; interrupted, resumed, folders of others refused."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")

from openvima.atomic_io import folder_lock
from openvima.errors import ConfigError, FolderLockedError
from openvima.studies import (
    STUDIES,
    Demonstrations,
    EvaluationSettings,
    Run,
    Study,
    StudyInputs,
    check_options,
    make_study,
    run_study,
    scale_named,
)
from openvima.studies.plan import plan_study
from openvima.training.building import resolve

INPUTS = StudyInputs(scale_named("nano"))
OUT = Path("/study")


def study_of(*runs: Run, **values: object) -> Study:
    made = Study(
        "test",
        "Does it work?",
        "run",
        runs,
        EvaluationSettings(("rotate",), ("L1",), 5),
        Demonstrations(("rotate",), 10),
    )
    return replace(made, **values)


def test_fractions_differ_by_seed_and_share_their_source() -> None:
    study = study_of(Run("all"), Run("tenth", data_fraction=0.1))
    plan = plan_study(study, INPUTS, OUT, seeds=2)
    assert [config.out for config in plan.data.values()] == [OUT / "data/1"]
    assert [(s.out.name, s.seed) for s, _ in plan.subsets.values()] == [
        ("1-0.1-seed-0", 0),
        ("1-0.1-seed-1", 1),
    ]
    assert [t.config.data.name for t in plan.trainings] == ["1", "1", "1-0.1-seed-0", "1-0.1-seed-1"]
    assert [t.config.seed for t in plan.trainings] == [0, 1, 0, 1]
    assert [e.config.seed for e in plan.evaluations] == [0, 5, 0, 5]  # episodes of their own


def test_pretraining_of_several_runs_is_trained_once_for_each_seed() -> None:
    init = {"augmentation.inverse_dynamics_prob": 1.0}
    study = study_of(Run("a", init=init), Run("b", init=init, settings={"schedule.steps": 7}), Run("c"))
    plan = plan_study(study, INPUTS, OUT, seeds=2)
    assert list(plan.initial) == [OUT / f"initial/1/seed-{seed}" for seed in (0, 1)]
    sources = [t.config.init_from for t in plan.trainings]
    assert sources == [str(OUT / f"initial/1/seed-{seed}") for seed in (0, 1, 0, 1)] + [None] * 2
    assert plan.trainings[2].config.schedule.steps == 7


def test_policies_that_exist_are_evaluated_once() -> None:
    plan = plan_study(study_of(Run("oracle", policy="oracle"), data=None), INPUTS, OUT, seeds=3)
    assert not plan.trainings and len(plan.evaluations) == 1


@pytest.mark.parametrize("scale", ["nano", "2m"])
@pytest.mark.parametrize("name", STUDIES)
def test_every_study_can_be_planned_at_every_scale(name: str, scale: str) -> None:
    t5, checkpoint = (None, "openvima-small") if scale == "nano" else ("t5-base", "checkpoint")
    assets = "original" if name == "published" else "procedural"
    inputs = StudyInputs(scale_named(scale), ("oracle",), t5, assets, checkpoint)
    study = make_study(name, inputs)
    plan = plan_study(study, inputs, OUT, seeds=2)
    assert study.name == name
    assert plan.num_stages >= len(study.runs)
    for training in plan.all_trainings:
        resolve(training.config)


def test_networks_of_the_papers_share_pretrained_crops_at_nano_unless_some_take_frames() -> None:
    for name, crops in (("conditioning", "openvima-vima"), ("image-tokens", None)):
        plan = plan_study(make_study(name, INPUTS), INPUTS, OUT, seeds=1)
        assert {training.config.crops_from for training in plan.trainings} == {crops}
        assert not any(training.config.pretraining.steps for training in plan.trainings)


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ((), "at least one"),
        ((Run("a"), Run("a")), "other labels"),
    ],
)
def test_runs_that_cannot_be_are_refused(runs: tuple[Run, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        study_of(*runs)


def test_labels_with_the_same_folder_and_no_seed_are_refused() -> None:
    with pytest.raises(ConfigError, match="same folders"):
        plan_study(study_of(Run("1 %"), Run("1")), INPUTS, OUT, seeds=1)
    with pytest.raises(ConfigError, match="seeds is 0"):
        plan_study(study_of(Run("a")), INPUTS, OUT, seeds=0)


def test_options_that_a_study_needs_or_does_not_take_are_one_line() -> None:
    large = StudyInputs(scale_named("2m"))
    with pytest.raises(ConfigError, match="--t5"):
        make_study("conditioning", large)
    with pytest.raises(ConfigError, match="--checkpoint"):
        make_study("published", INPUTS)
    with pytest.raises(ConfigError, match="--assets"):
        make_study("published", replace(INPUTS, checkpoint="folder"))
    with pytest.raises(ConfigError, match="takes no --policy; distractors and corrupted-prompts do"):
        check_options("midas", replace(INPUTS, policies=("oracle",)))


def test_a_mistyped_study_gets_a_suggestion() -> None:
    with pytest.raises(ConfigError, match="data-scaling"):
        make_study("data-scalin", INPUTS)


def test_the_example_of_the_documentation_can_be_planned(tmp_path: Path) -> None:
    page = Path(__file__).parents[2] / "docs/studies.md"
    example = page.read_text().split("```python\n")[1].split("```")[0]
    (tmp_path / "learning_rates.py").write_text(example)
    study = make_study(f"{tmp_path / 'learning_rates.py'}:learning_rates", INPUTS)
    plan = plan_study(study, INPUTS, OUT, seeds=2)
    assert [training.config.preset for training in plan.trainings] == ["vima-nano"] * 4


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
    pytest.importorskip("matplotlib")
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"
    page = run_study(STUDY, INPUTS, whole)
    assert "Does it resume?" in page.read_text(encoding="utf-8")
    for stage in (2, 4):

        def interrupt(done: int, total: int, note: str, at: int = stage) -> None:
            if done == at and "steps" in note:  # amid a training
                raise Interrupted

        with pytest.raises(Interrupted):
            run_study(STUDY, INPUTS, resumed, report=interrupt)
        assert not (resumed / "study.json").exists()
    run_study(STUDY, INPUTS, resumed)
    assert points(resumed) == points(whole)
    costs = json.loads((resumed / "study.json").read_text(encoding="utf-8"))["costs"]
    assert [cost["demonstrations"] for cost in (*costs["all"], *costs["half"])] == [2, 1]


def test_a_folder_of_another_study_or_of_another_process_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    study = replace(STUDY, runs=(Run("oracle", policy="oracle"),))
    run_study(study, INPUTS, tmp_path)
    with pytest.raises(ConfigError, match=r"evaluation\.episodes is 1 there and 2 here"):
        run_study(replace(study, evaluation=replace(study.evaluation, episodes=2)), INPUTS, tmp_path)
    with folder_lock(tmp_path), pytest.raises(FolderLockedError):
        run_study(study, INPUTS, tmp_path)
