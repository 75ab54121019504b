"""Checkpoints: equal weights come back, damage is told in one message, and folders are found."""

import pytest

torch = pytest.importorskip("torch")

import yaml  # noqa: E402
from safetensors.torch import load_file, save_file  # noqa: E402

from openvima.errors import CheckpointError  # noqa: E402
from openvima.policies.base import BEST_FILE, CHECKPOINTS_FOLDER, checkpoint_folder, load_policy  # noqa: E402
from openvima.policies.checkpoint import (  # noqa: E402
    CONFIG_FILE,
    WEIGHTS_FILE,
    load_checkpoint,
    load_weights,
    save_checkpoint,
)
from openvima.policies.network import build_network  # noqa: E402


@pytest.fixture
def saved(small_sizes, tmp_path):
    """A checkpoint folder of a small network."""
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    save_checkpoint(build_network(small_sizes, seed=3), folder)
    return folder


def test_weights_and_sizes_come_back_bit_for_bit(saved, small_sizes) -> None:
    loaded, model = load_checkpoint(saved), build_network(small_sizes, seed=3)
    assert loaded.config == small_sizes
    assert not loaded.training
    expected = model.state_dict()
    assert loaded.state_dict().keys() == expected.keys()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in loaded.state_dict().items())


def test_saving_again_gives_the_same_bytes(saved, small_sizes, tmp_path) -> None:
    again = tmp_path / "again"
    again.mkdir()
    save_checkpoint(load_checkpoint(saved), again)
    for name in (WEIGHTS_FILE, CONFIG_FILE):
        assert (again / name).read_bytes() == (saved / name).read_bytes()


def test_every_kind_of_problem_is_in_one_message_and_nothing_is_loaded(small_sizes) -> None:
    model = build_network(small_sizes, seed=0)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    weights = {name: tensor + 1 for name, tensor in before.items()}
    del weights["query"]
    weights["surplus"] = torch.zeros(2)
    weights["end_effectors.weight"] = torch.zeros(3, 2)
    weights["observation_out.bias"] = weights["observation_out.bias"].double()
    with pytest.raises(CheckpointError) as caught:
        load_weights(model, weights, source="here")
    message = str(caught.value)
    for part in (
        "here does not fit",
        "missing: query",
        "unexpected: surplus",
        "end_effectors.weight is float32 (3, 2) instead of float32 (2, 2)",
        "observation_out.bias is float64",
    ):
        assert part in message
    assert "\n" not in message
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())


def test_many_missing_weights_are_counted_rather_than_listed(small_sizes) -> None:
    model = build_network(small_sizes, seed=0)
    with pytest.raises(CheckpointError, match=rf"and {len(model.state_dict()) - 5} more"):
        load_weights(model, {}, source="here")


@pytest.mark.parametrize("kept", [0, 7, 1000, -1])
def test_a_truncated_file_is_named_as_damaged(saved, kept: int) -> None:
    file = saved / WEIGHTS_FILE
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(CheckpointError, match=r"model\.safetensors is damaged"):
        load_checkpoint(saved)


@pytest.mark.parametrize("name", [WEIGHTS_FILE, CONFIG_FILE])
def test_a_missing_file_is_named(saved, name: str) -> None:
    (saved / name).unlink()
    with pytest.raises(CheckpointError, match=f"it holds no {name}"):
        load_policy(str(saved))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "no valid YAML"),
        ("", "does not describe"),
        ("policy: gato\nconfig: {}\n", "does not describe a 'network' policy"),
        ("policy: network\nconfig: 3\n", "must be a mapping"),
        ("policy: network\nconfig: {}\n", "missing 5 required"),
    ],
)
def test_a_config_that_makes_no_sense_is_a_checkpoint_error(saved, text: str, message: str) -> None:
    (saved / CONFIG_FILE).write_text(text)
    with pytest.raises(CheckpointError, match=message):
        load_checkpoint(saved)


def test_weights_of_other_sizes_are_refused(saved) -> None:
    values = yaml.safe_load((saved / CONFIG_FILE).read_text())
    values["config"]["action_width"] += 1
    (saved / CONFIG_FILE).write_text(yaml.safe_dump(values))
    with pytest.raises(CheckpointError, match=r"wrong: actions\.parts"):
        load_checkpoint(saved)


def test_weights_with_a_name_too_many_are_refused(saved) -> None:
    weights = load_file(saved / WEIGHTS_FILE)
    save_file({**weights, "surplus": torch.zeros(1)}, saved / WEIGHTS_FILE)
    with pytest.raises(CheckpointError, match="unexpected: surplus"):
        load_checkpoint(saved)


def test_of_a_run_the_best_checkpoint_is_taken_else_the_last(tmp_path) -> None:
    checkpoints = tmp_path / CHECKPOINTS_FOLDER
    for name in ("2-cloning-000200", "2-cloning-000400", "2-cloning-000600.partial"):
        (checkpoints / name).mkdir(parents=True)
    assert checkpoint_folder(tmp_path).name == "2-cloning-000400"
    (checkpoints / BEST_FILE).write_text("2-cloning-000200\n")
    assert checkpoint_folder(tmp_path).name == "2-cloning-000200"
    (checkpoints / BEST_FILE).write_text("2-cloning-000100")
    assert checkpoint_folder(tmp_path).name == "2-cloning-000400"
    assert checkpoint_folder(checkpoints / "2-cloning-000400").name == "2-cloning-000400"


def test_a_run_without_a_checkpoint_yet_is_refused(tmp_path) -> None:
    (tmp_path / CHECKPOINTS_FOLDER).mkdir()
    with pytest.raises(CheckpointError, match="no checkpoint"):
        load_policy(str(tmp_path))
