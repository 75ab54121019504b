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
from openvima.evaluation.config import plan
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


@pytest.mark.parametrize("kind", [str, Path])
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda **given: EvaluationConfig(("oracle",), **given), "out"),
        (GenerateConfig, "out"),
        (lambda **given: ImportConfig(source=Path("a"), **given), "out"),
        (lambda **given: ImportConfig(out=Path("a"), **given), "source"),
        (lambda **given: LerobotConfig(data=Path("a"), **given), "out"),
        (lambda **given: LerobotConfig(out=Path("a"), **given), "data"),
        (lambda **given: SubsetConfig(source=Path("a"), **given), "out"),
        (lambda **given: MergeConfig(sources=(Path("a"),), **given), "out"),
        (training, "out"),
        (training, "data"),
        (training, "object_cache"),
        (detector, "init_from"),
    ],
)
def test_settings_with_a_path_take_text_and_home(
    home: Path, make: Callable[..., object], name: str, kind: Callable
) -> None:
    assert getattr(make(**{name: kind("~/here")}), name) == home / "here"
    assert getattr(make(**{name: kind("here")}), name) == Path("here")


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda **given: EvaluationConfig(**{"policies": ("oracle",), **given}), "policies"),
        (lambda **given: EvaluationConfig(("oracle",), **given), "tasks"),
        (lambda **given: EvaluationConfig(("oracle",), **given), "levels"),
        (lambda **given: GenerateConfig(Path("a"), **given), "tasks"),
        (lambda **given: ImportConfig(Path("a"), Path("b"), **given), "tasks"),
        (lambda **given: LerobotConfig(Path("a"), Path("b"), **given), "tasks"),
        (lambda **given: SubsetConfig(Path("a"), Path("b"), **given), "tasks"),
        (lambda **given: MergeConfig((Path("a"),), Path("b"), **given), "tasks"),
    ],
)
def test_settings_with_a_list_take_a_single_name_and_any_list(make: Callable[..., object], name: str) -> None:
    assert getattr(make(**{name: "rotate"}), name) == ("rotate",)
    assert getattr(make(**{name: ["rotate", "twist"]}), name) == ("rotate", "twist")


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


def test_batches_of_other_processes_have_whole_paths(home: Path) -> None:
    (home / "lr=0.001").mkdir()
    (batch,) = plan(EvaluationConfig("lr=0.001", tasks="rotate", levels="L1", episodes=1))  # type: ignore
    assert batch.with_whole_paths().source == str(home / "lr=0.001")
