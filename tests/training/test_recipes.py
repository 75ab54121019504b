"""Recipes and files of settings, their precedence on the command line, and runs that it starts."""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from openvima.cli.main import main
from openvima.cli.train import parse
from openvima.errors import ConfigError
from openvima.policies import load_policy
from openvima.training import TrainingConfig
from openvima.training.building import resolve
from openvima.training.recipes import (
    RECIPES,
    default_recipe,
    read_settings,
    recipe_settings,
)
from small_networks import assert_it_acts


@pytest.fixture
def trained(monkeypatch) -> list[TrainingConfig]:
    """What the command line would train, in this process alone."""
    configs: list[TrainingConfig] = []

    def train(config, report, rollout, animate) -> Path:
        configs.append(config)
        return config.out

    monkeypatch.setattr("openvima.training.train", train)
    monkeypatch.setattr("openvima.training.parallel.start_peers", lambda others, words: nullcontext())
    return configs


def test_every_recipe_is_valid_and_that_of_the_paper_as_published() -> None:
    configs = {
        name: TrainingConfig.of({"data": Path("demos"), "out": Path("run"), **recipe_settings(name)})
        for name in RECIPES
    }
    for config in configs.values():
        assert config.loader.batch_size % config.optimizer.grad_accum_steps == 0
    paper = configs["paper"]
    optimizer, schedule = paper.optimizer, paper.schedule
    assert (optimizer.learning_rate, optimizer.weight_decay, optimizer.max_grad_norm) == (1e-4, 0.0, 1.0)
    assert (schedule.warmup_steps, schedule.decay_steps, schedule.final_learning_rate) == (7000, 17000, 1e-7)
    assert (paper.loader.batch_size, schedule.epochs) == (128, 10)
    assert paper.augmentation.false_positive_prob == 0.05


def test_every_preset_has_a_recipe_that_trains_it() -> None:
    assert default_recipe("vima-nano") == "papers" and default_recipe("midas-nano") == "papers-midas"
    assert default_recipe("gato-nano") == default_recipe("gpt-nano") == "papers-frames"
    for name in ("vima-nano", "midas-nano", "gato-nano", "flamingo-nano", "gpt-nano"):
        given = {"data": Path("demos"), "out": Path("run"), "preset": name}
        resolve(TrainingConfig.of({**recipe_settings(default_recipe(name)), **given}))
    assert default_recipe("nano") == default_recipe("mine:learner") == "nano"
    assert default_recipe("small:learner") == default_recipe("nano-bins") == "nano"
    assert default_recipe("vima-20m") == default_recipe(None) == "paper"
    with pytest.raises(ConfigError, match="Did you mean 'paper'"):
        recipe_settings("papper")


@pytest.mark.parametrize(
    ("options", "points", "pretraining"),
    [
        ([], True, 4000),
        (["--model.image-tokens", "object-perceiver", "--model.conditioning", "prefix"], None, 4000),
        (["--model.image-tokens=patches"], None, 0),
        (["--model.head", "autoregressive"], True, 4000),
        (["--init-from", "openvima-vima"], True, 0),
    ],
)
def test_a_recipe_leaves_out_what_other_parts_of_the_network_cannot_have(
    options, points, pretraining
) -> None:
    config = resolve(parse(["--data", "demos", "--out", "run", "--preset", "vima-nano", *options]))
    assert config.model.points == points
    assert config.pretraining.steps == pretraining
    assert config.schedule.steps == recipe_settings("papers")["schedule.steps"]


def test_options_take_precedence_over_the_file_and_the_file_over_the_recipe(trained, tmp_path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("{optimizer: {learning_rate: 0.5}, loader: {batch_size: 7}, data: demos}")
    words = f"train --config {file} --recipe paper --preset nano --loader.batch-size 9 --out run"
    assert main(words.split()) == 0
    (config,) = trained
    assert (config.loader.batch_size, config.optimizer.learning_rate) == (9, 0.5)
    assert config.schedule.warmup_steps == 7000
    assert (config.data, config.out, config.preset) == (Path("demos"), Path("run"), "nano")


def test_preset_and_recipe_decide_on_each_other(trained) -> None:
    assert default_recipe("small") == "small"
    for words in (
        [],
        ["--preset", "nano"],
        ["--preset", "small"],
        ["--recipe", "small"],
        ["--recipe", "small", "--schedule.steps", "9"],
    ):
        assert main(["train", "--data", "demos", "--out", "run", *words]) == 0
    default, nano, first, second, third = (resolve(config) for config in trained)
    assert default == nano and (nano.preset, nano.optimizer.learning_rate) == ("nano", 1e-3)
    assert first == second == replace(third, schedule=first.schedule)
    assert (first.preset, first.pretraining.steps) == ("small", 4000)
    assert (first.schedule.steps, third.schedule.steps) == (3100, 9)


def test_init_from_disables_pretraining_unless_it_is_set(trained, tmp_path) -> None:
    of_a_run, of_its_own = tmp_path / "config.yaml", tmp_path / "mine.yaml"
    of_a_run.write_text("{training: {preset: small, pretraining: {steps: 3000}}}")
    of_its_own.write_text("{preset: small, init_from: other, pretraining: {steps: 7}}")
    without = tmp_path / "without.yaml"
    without.write_text("{preset: small, init_from: other}")
    init = ["--init-from", "other"]
    for words, expected in (
        (["--preset", "small", *init], 0),
        (["--preset", "nano", *init], 0),
        (["--preset", "small", *init, "--pretraining.steps", "5"], 5),
        (["--config", str(of_a_run), *init], 0),
        (["--config", str(of_its_own)], 7),
        (["--config", str(of_its_own), *init], 0),
        (["--config", str(without)], 0),
        (["--preset", "small", "--init-from", "None"], 4000),
        (["--preset", "vima-nano", "--crops-from", "other"], 0),
    ):
        assert main(["train", "--data", "demos", "--out", "run", *words]) == 0
        assert resolve(trained[-1]).pretraining.steps == expected, words


def test_init_from_shows_no_tasks_first_unless_it_is_asked_to(trained) -> None:
    words = ["train", "--preset", "midas-nano", "--data", "demos", "--out", "run"]
    for more, expected in (
        ([], 1000),
        (["--init-from", "other"], 0),
        (["--init-from", "other", "--loader.first-steps", "5"], 5),
    ):
        assert main([*words, *more]) == 0
        assert trained[-1].loader.first_steps == expected


def test_steps_replace_the_epochs_of_a_recipe(trained, tmp_path) -> None:
    words = ["train", "--recipe", "workstation", "--preset", "nano", "--data", "demos", "--out", "run"]
    file = tmp_path / "mine.yaml"
    file.write_text("schedule: {steps: 7}")
    for more in (
        [],
        ["--schedule.steps", "5"],
        ["--config", str(file)],
        ["--schedule.steps", "5", "--schedule.epochs", "2"],
    ):
        assert main([*words, *more]) == 0
    assert [config.schedule.epochs for config in trained] == [10, None, None, 2]
    assert [config.schedule.steps for config in trained][1:] == [5, 7, 5]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schedule: {stepps: 3}", "no setting in .* called 'schedule.stepps'. Did you mean 'schedule.steps'"),
        ("- 3", "must hold settings"),
        ("a: [", "is no valid YAML"),
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


@pytest.mark.parametrize(
    "text", ["preset: evil:make", "loader: {boxes: 'evil.py:make'}", "loader: {boxes: 'evil=x:make'}"]
)
def test_code_that_a_file_names_runs_only_with_trust_code(text: str, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("evil.py", "evil=x.py"):
        (tmp_path / name).write_text("import pathlib\npathlib.Path('executed').touch()\n")
    monkeypatch.syspath_prepend(tmp_path)
    file = tmp_path / "theirs.yaml"
    file.write_text(text)
    assert main(["train", "--config", str(file), "--data", "demos", "--out", "run"]) == 2
    assert "names code to run" in capsys.readouterr().err
    assert not (tmp_path / "executed").exists()
    assert read_settings(file, trust_code=True)


STEPS = 2


def run_train(data: Path, out: Path, preset: str, *options: str) -> int:
    # The recipe of the preset begins with 1,600 steps of pretraining.
    words = f"train --data {data} --out {out} --preset {preset} --recipe nano --loader.batch-size 3"
    words += f" --schedule.steps {STEPS} --schedule.checkpoint-every {STEPS}"
    return main([*words.split(), *options])


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["flamingo", "midas"])
def test_a_run_makes_a_working_policy(architecture, data, tmp_path) -> None:
    assert run_train(data, tmp_path, f"{architecture}-nano") == 0
    assert_it_acts(tmp_path)


@pytest.mark.parametrize("finetune", ["False", pytest.param("True", marks=pytest.mark.slow)])
def test_crops_of_initial_weights_are_frozen_where_it_is_asked_for(finetune, data, tmp_path):
    option = ("--pretraining.finetune-crop-encoder", finetune)
    assert run_train(data, tmp_path / "on", "vima-nano", "--init-from", "openvima-vima", *option) == 0
    last = next((tmp_path / "on" / "checkpoints").glob(f"*-{STEPS:06}"))
    before = load_policy("openvima-vima").network.state_dict()
    after = load_file(last / "model.safetensors")
    names = [name for name in before if name.startswith("images.crop_encoder")]
    same = [torch.equal(before[name], after[name]) for name in names]
    assert names and (all(same) if finetune == "False" else not any(same))
    assert not torch.equal(before["head.classifiers.0.0.weight"], after["head.classifiers.0.0.weight"])
