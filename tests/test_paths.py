"""Paths are text or `Path`, `~` is the user's home, single names are lists, and what exists is a path."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from openvima.cli.main import main
from openvima.data import Dataset, GenerateConfig, verify
from openvima.data.lerobot import LerobotConfig
from openvima.data.published import ImportConfig
from openvima.data.subsets import MergeConfig, SubsetConfig
from openvima.evaluation import EvaluationConfig, Results, score
from openvima.policies import RandomPolicy, load_policy


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's home, which is the current folder as well."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def training(**settings: Any) -> Any:
    pytest.importorskip("torch")
    from openvima.training import TrainingConfig

    return TrainingConfig(**{"data": "demos", "out": "run", **settings})


def detector(**settings: Any) -> Any:
    pytest.importorskip("torch")
    from openvima.training.detector import DetectorTrainingConfig

    return DetectorTrainingConfig(**{"data": "demos", "out": "run", **settings})


HERE = "~/here"


@pytest.mark.parametrize("kind", [str, Path])
@pytest.mark.parametrize(
    ("make", "given"),
    [
        (EvaluationConfig, {"policies": "oracle", "tasks": "rotate", "levels": "L1", "out": HERE}),
        (GenerateConfig, {"out": HERE, "tasks": "rotate"}),
        (ImportConfig, {"source": HERE, "out": HERE, "tasks": "rotate"}),
        (LerobotConfig, {"data": HERE, "out": Path("b"), "tasks": "rotate"}),
        (LerobotConfig, {"data": Path("a"), "out": HERE}),
        (SubsetConfig, {"source": HERE, "out": HERE, "tasks": "rotate"}),
        (MergeConfig, {"sources": (Path("a"),), "out": HERE, "tasks": "rotate"}),
        (training, {"data": HERE, "out": HERE, "object_cache": HERE}),
        (detector, {"init_from": HERE}),
    ],
)
def test_settings_take_text_paths_and_single_names(
    home: Path, make: Callable, given: dict, kind: Callable
) -> None:
    paths = {name for name, value in given.items() if value == HERE}
    lists = {name for name, value in given.items() if isinstance(value, str)} - paths
    made = make(**{**given, **dict.fromkeys(paths, kind(HERE))})
    assert {getattr(made, name) for name in paths} == {home / "here"}
    assert all(getattr(made, name) == (given[name],) for name in lists)
    several = {name: ["rotate", "twist"] for name in lists}
    made = make(**{**given, **dict.fromkeys(paths, kind("here")), **several})
    assert {getattr(made, name) for name in paths} == {Path("here")}
    assert all(getattr(made, name) == ("rotate", "twist") for name in lists)


def test_a_policy_is_loaded_from_text_path_and_home(home: Path) -> None:
    pytest.importorskip("torch")
    from openvima.policies.inference import NetworkPolicy

    policy = load_policy("untrained:nano")
    assert isinstance(policy, NetworkPolicy)
    for kind in (str, Path):
        policy.save_pretrained(kind("~/runs/mine"))
        for given in ("runs/mine", "~/runs/mine"):
            assert isinstance(load_policy(kind(given)), NetworkPolicy)


def test_data_and_results_are_named_by_text_path_and_home(home: Path) -> None:
    assert main(["generate", "--tasks=rotate", "--episodes=1", "--out=~/demos"]) == 0
    results = score({"random": RandomPolicy()}, tasks="rotate", levels="L1", episodes=1)
    for kind in (str, Path):
        dataset = Dataset(kind("~/demos"), tasks="rotate")
        assert len(dataset) == 1 and dataset.tasks == ("rotate",)
        assert verify(kind("~/demos")).folder == home / "demos"
        results.write(kind("~/results.json"))
        assert Results.read(kind("~/results.json")).rows == results.rows
    assert not Path("~").exists()
