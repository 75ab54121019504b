"""Named settings, files of settings, and what the command line makes of them."""

from dataclasses import replace
from pathlib import Path

import pytest
import yaml

pytest.importorskip("torch")

from openvima.cli.main import main
from openvima.errors import ConfigError
from openvima.training import TrainingConfig
from openvima.training.building import resolved
from openvima.training.recipes import (
    RECIPES,
    default_recipe,
    read_settings,
    recipe_settings,
)


@pytest.fixture
def trained(monkeypatch) -> list[TrainingConfig]:
    """What the command line would train."""
    configs: list[TrainingConfig] = []

    def train(config, report, rollout) -> Path:
        configs.append(config)
        return config.out

    monkeypatch.setattr("openvima.training.train", train)
    return configs


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_is_a_run_that_could_be(name: str) -> None:
    config = TrainingConfig(data=Path("demos"), out=Path("run"), **recipe_settings(name))
    assert config.batch % config.accumulate == 0


def test_the_paper_recipe_is_that_of_the_paper() -> None:
    config = TrainingConfig(data=Path("demos"), out=Path("run"), **recipe_settings("paper"))
    assert (config.learning_rate, config.weight_decay, config.clip_norm) == (1e-4, 0.0, 1.0)
    assert (config.warmup_steps, config.decay_steps, config.final_learning_rate) == (7000, 17000, 1e-7)
    assert (config.batch, config.epochs, config.spurious_probability) == (128, 10, 0.05)


def test_nano_presets_and_own_learners_have_the_recipe_of_minutes() -> None:
    assert default_recipe("vima-nano") == default_recipe("mine:learner") == "nano"
    assert default_recipe("small:learner") == default_recipe("nano-bins") == "nano"
    assert default_recipe("vima-20m") == default_recipe(None) == "paper"
    with pytest.raises(ConfigError, match="Did you mean 'paper'"):
        recipe_settings("papper")


def test_what_is_given_counts_more_than_the_file_and_that_more_than_the_recipe(trained, tmp_path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("learning_rate: 0.5\nbatch: 7\ndata: demos\n")
    words = ["train", "--config", str(file), "--recipe", "paper", "--preset", "nano", "--batch", "9"]
    assert main([*words, "--out", "run"]) == 0
    (config,) = trained
    assert (config.batch, config.learning_rate, config.warmup_steps) == (9, 0.5, 7000)
    assert (config.data, config.out, config.preset) == (Path("demos"), Path("run"), "nano")


def test_the_preset_decides_on_the_recipe(trained) -> None:
    for preset in ("nano", "vima-20m"):
        assert main(["train", "--data", "demos", "--out", "run", "--preset", preset]) == 0
    assert [config.learning_rate for config in trained] == [1e-3, 1e-4]
    assert [config.preset for config in trained] == ["nano", "vima-20m"]
    assert main(["train", "--data", "demos", "--out", "run"]) == 0
    assert trained[-1] == trained[0]


def test_the_small_policy_is_trained_by_one_command(trained) -> None:
    assert default_recipe("small") == "small"
    for words in (["--preset", "small"], ["--recipe", "small"], ["--recipe", "small", "--steps", "9"]):
        assert main(["train", "--data", "demos", "--out", "run", *words]) == 0
    first, second, third = (resolved(config) for config in trained)
    assert first == second == replace(third, steps=first.steps)
    assert (first.preset, first.pretraining_steps, first.steps, third.steps) == ("small", 4000, 3100, 9)
    assert (first.pretraining_grays, first.pretraining_gaps) == (0.3, 0.35)
    assert (first.batch, first.motion_share, first.naming_share) == (128, 0.2, 0.3)
    assert (first.reordering_share, first.stranger_share) == (0.3, 0.6)


def test_weights_to_begin_with_are_not_pretrained_again_unless_that_is_asked_for(trained, tmp_path) -> None:
    of_a_run, of_its_own = tmp_path / "config.yaml", tmp_path / "mine.yaml"
    of_a_run.write_text("{training: {preset: small, pretraining_steps: 3000}}")
    of_its_own.write_text("{preset: small, init: other, pretraining_steps: 7}")
    without = tmp_path / "without.yaml"
    without.write_text("{preset: small, init: other}")
    init = ["--init", "other"]
    for words, expected in (
        (["--preset", "small", *init], 0),
        (["--preset", "nano", *init], 0),
        (["--preset", "small", *init, "--pretraining-steps", "5"], 5),
        (["--config", str(of_a_run), *init], 0),
        (["--config", str(of_its_own)], 7),
        (["--config", str(of_its_own), *init], 0),
        (["--config", str(without)], 0),
        (["--preset", "small", "--init", "None"], 4000),
    ):
        assert main(["train", "--data", "demos", "--out", "run", *words]) == 0
        assert resolved(trained[-1]).pretraining_steps == expected, words


def test_the_settings_of_another_run_can_be_taken(trained, tmp_path) -> None:
    file = tmp_path / "config.yaml"
    file.write_text(yaml.safe_dump({"training": {"steps": 5, "epochs": None}, "policy": {}}))
    assert main(["train", "--config", str(file), "--data", "demos", "--out", "run"]) == 0
    assert trained[0].steps == 5


def test_steps_replace_the_epochs_of_a_recipe(trained, tmp_path) -> None:
    words = ["train", "--recipe", "workstation", "--preset", "nano", "--data", "demos", "--out", "run"]
    file = tmp_path / "mine.yaml"
    file.write_text("steps: 7")
    for more in ([], ["--steps", "5"], ["--config", str(file)], ["--steps", "5", "--epochs", "2"]):
        assert main([*words, *more]) == 0
    assert [config.epochs for config in trained] == [10, None, None, 2]
    assert [config.steps for config in trained][1:] == [5, 7, 5]


def test_numbers_of_files_may_have_an_exponent_and_no_point(tmp_path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("learning_rate: 1e-4\ntokens: cache\nkeep_every: null")
    assert read_settings(file) == {"learning_rate": 1e-4, "tokens": Path("cache"), "keep_every": None}


def test_only_the_first_of_several_processes_prints(trained, monkeypatch, capsys) -> None:
    words = ["train", "--data", "demos", "--out", "run"]
    for rank, printed in (("0", "run\n"), ("1", "")):
        monkeypatch.setenv("RANK", rank)
        assert main(words) == 0
        assert capsys.readouterr().out == printed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stepps: 3", "there is no setting in .* called 'stepps'. Did you mean 'steps'"),
        ("- 3", "must hold settings"),
        ("a: [", "cannot be read as YAML"),
    ],
)
def test_a_file_that_holds_no_settings_is_named(text: str, message: str, tmp_path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_settings(file)
    with pytest.raises(ConfigError, match=r"gone\.yaml cannot be read"):
        read_settings(tmp_path / "gone.yaml")


def test_what_is_missing_or_unknown_is_wrong_usage(capsys) -> None:
    with pytest.raises(SystemExit) as caught:
        main(["train", "--out", "run"])
    assert caught.value.code == 2
    assert "--data" in capsys.readouterr().err
    assert main(["train", "--recipe", "papper", "--data", "d", "--out", "r"]) == 2
