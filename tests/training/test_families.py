"""Each architecture from demonstrations to actions, on the command line."""

import shlex
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file

from openvima.cli.main import main
from openvima.policies import load_policy
from small_networks import assert_it_acts

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


@pytest.mark.slow
@pytest.mark.parametrize("architecture", ["flamingo", "midas"])
def test_a_run_makes_a_working_policy(architecture, data, tmp_path) -> None:
    assert run_train(data, tmp_path, f"{architecture}-nano") == 0
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
