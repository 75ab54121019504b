"""Each architecture from demonstrations to actions, on the command line."""

import json
import re
import shlex
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file

from openvima.cli.main import main
from openvima.env import TabletopEnv
from openvima.policies import load_policy, presets
from openvima.policies.build import build_network
from openvima.scene import Action
from openvima.training.behaviour_cloning import BehaviourCloning
from openvima.training.loop import step_seed

STEPS = 3


def run_train(data: Path, out: Path, preset: str, *options: object) -> int:
    words = [
        "train",
        "--data",
        data,
        "--out",
        out,
        "--preset",
        preset,
        "--recipe",
        "nano",  # that of the preset begins with 1,600 steps of pretraining
        "--schedule.steps",
        STEPS,
        "--loader.batch-size",
        3,
    ]
    return main([str(word) for word in (*words, "--schedule.checkpoint-every", 1, *options)])


def assert_it_acts(run: Path) -> None:
    policy, env = load_policy(str(run)), TabletopEnv("rotate")
    observation, _ = env.reset(seed=0)
    policy.reset([env.prompt])
    (action,) = policy.act([observation])
    assert action is not None
    Action.from_arrays(action)


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["flamingo", "midas"])
def test_a_run_makes_a_working_policy(architecture, data, tmp_path) -> None:
    assert run_train(data, tmp_path, f"{architecture}-nano") == 0
    assert_it_acts(tmp_path)


def test_an_interrupted_run_resumes_to_a_working_policy(data, tmp_path, monkeypatch) -> None:
    preset, whole, torn = "vima-nano", tmp_path / "whole", tmp_path / "torn"
    assert run_train(data, whole, preset) == 0
    backward = BehaviourCloning.backward

    def interrupted(self: BehaviourCloning, step: int) -> dict[str, float]:
        if step == 2:
            raise KeyboardInterrupt
        return backward(self, step)

    monkeypatch.setattr(BehaviourCloning, "backward", interrupted)
    assert run_train(data, torn, preset) == 130
    monkeypatch.undo()
    assert run_train(data, torn, preset) == 0
    last = f"checkpoints/2-cloning-{STEPS:06d}/model.safetensors"
    expected, actual = load_file(whole / last), load_file(torn / last)
    assert expected.keys() == actual.keys()
    assert all(torch.equal(tensor, actual[name]) for name, tensor in expected.items())
    assert_it_acts(torn)


@pytest.mark.slow
def test_without_an_appearance_embedding_there_is_no_pretraining_and_the_image_encoder_is_trained(
    data, tmp_path, capsys
) -> None:
    assert run_train(data, tmp_path, "gpt-nano", "--loader.validation-fraction", 0.3) == 0
    assert re.search(rf"2-cloning, step {STEPS}, held out: loss .*pick \d+%.*place", capsys.readouterr().err)
    assert yaml.safe_load((tmp_path / "config.yaml").read_text())["training"]["pretraining"]["steps"] == 0
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert {line["name"] for line in lines} == {"2-cloning"}
    metrics = {name for line in lines for name in line}
    assert {"accuracy", "place_accuracy", "validation_rotation_accuracy", "query_spread"} <= metrics
    fresh = build_network(presets.preset("gpt-nano"), seed=step_seed(0, "weights", 0)).state_dict()
    trained = load_file(tmp_path / f"checkpoints/2-cloning-{STEPS:06d}/model.safetensors")
    images = [name for name in fresh if name.startswith("images.")]
    assert all(not torch.equal(fresh[name], trained[name]) for name in images)
    assert_it_acts(tmp_path)


def test_a_finished_run_that_is_to_be_longer_names_the_command_that_goes_on(data, tmp_path, capsys) -> None:
    run = tmp_path / "my run"
    assert run_train(data, run, "vima-nano", "--schedule.warmup-steps", 2) == 0
    capsys.readouterr()
    longer = ["--schedule.warmup-steps", 2, "--schedule.steps", STEPS + 2]
    assert run_train(data, run, "vima-nano", *longer) != 0
    error = " ".join(capsys.readouterr().err.split())
    assert "finished run, whose learning-rate schedule has ended. Train 2 more steps" in error
    _, command, _ = error.split("`")
    program, *words = shlex.split(command)
    assert program == "openvima" and main(words) == 0
    other = tmp_path / "my run-longer"
    settings = yaml.safe_load((other / "config.yaml").read_text())["training"]
    assert (settings["schedule"]["steps"], settings["schedule"]["warmup_steps"]) == (2, 2)
    assert settings["init_from"] == str(run)
    assert (other / "checkpoints" / "2-cloning-000002").is_dir()


def test_other_changes_of_a_run_name_no_command(data, tmp_path, capsys) -> None:
    assert run_train(data, tmp_path, "vima-nano") == 0
    for changes in (["--schedule.steps", 9, "--seed", 1], ["--schedule.steps", 2]):
        assert run_train(data, tmp_path, "vima-nano", *changes) != 0
        error = " ".join(capsys.readouterr().err.split())
        assert "Give the same settings to continue it" in error and "--init-from" not in error
    state = tmp_path / f"checkpoints/2-cloning-{STEPS:06d}/state.json"
    state.write_text(state.read_text().replace(f'"step": {STEPS}', '"step": 1'))  # as if it was killed
    assert run_train(data, tmp_path, "vima-nano", "--schedule.steps", 9) != 0
    assert "Give the same settings to continue it" in " ".join(capsys.readouterr().err.split())


def test_training_from_a_preset_says_that_it_has_no_weights(data, tmp_path, capsys) -> None:
    assert run_train(data, tmp_path / "run", "vima-nano", "--init-from", "vima-nano") != 0
    error = " ".join(capsys.readouterr().err.split())
    assert "'vima-nano' is a preset: sizes of a network, without weights. Train it" in error
    assert not (tmp_path / "run" / "config.yaml").exists()


@pytest.mark.slow
def test_crops_without_an_appearance_embedding_can_be_pretrained_and_then_stay(data, tmp_path) -> None:
    options = ("--pretraining.steps", 2, "--pretraining.num-scenes", 40, "--pretraining.batch-size", 16)
    assert run_train(data, tmp_path, "vima-nano", "--schedule.keep-every", 1, *options) == 0
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert any("validation_retrieval_accuracy" in line for line in lines)
    files = sorted((tmp_path / "checkpoints").glob("*/model.safetensors"))
    trained = load_file(files[-1])
    fresh = build_network(presets.preset("vima-nano"), seed=step_seed(0, "weights", 0)).state_dict()
    crops = [name for name in trained if name.startswith("images.crop_encoder.")]
    assert crops and any(not torch.equal(trained[name], fresh[name]) for name in crops)
    first, *_, last = (load_file(file) for file in files if file.parent.name.startswith("2-"))
    assert all(torch.equal(first[name], last[name]) for name in crops)
    assert any(not torch.equal(first[name], last[name]) for name in trained)


def test_an_unknown_preset_is_wrong_usage_and_leaves_no_run_folder(data, tmp_path, capsys) -> None:
    assert run_train(data, tmp_path / "run", "gato-nanno") != 0
    assert "Did you mean 'gato-nano'?" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("finetune", ["False", "True"])
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
