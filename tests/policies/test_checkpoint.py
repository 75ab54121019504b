"""Checkpoints: round trips, errors for damaged files, and folders of runs; and files made to harm."""

import os
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from openvima.errors import InputFileError
from openvima.policies import checkpoint, preset
from openvima.policies.build import (
    build_network,
)
from openvima.policies.checkpoint import (
    CONFIG_FILE,
    WEIGHTS_FILE,
    load_checkpoint,
    load_weights,
    save_checkpoint,
)
from openvima.policies.loading import load_policy
from openvima.policies.naming import (
    BEST_FILE,
    CHECKPOINTS_FOLDER,
    checkpoint_folder,
)
from openvima.policies.published import load_published
from published_policies import small_vima, write_published


@pytest.fixture
def saved(small_sizes, tmp_path):
    """A checkpoint folder of a small network."""
    folder = tmp_path / "checkpoint"
    save_checkpoint(build_network(small_sizes, seed=3), folder)
    return folder


def test_weights_and_sizes_come_back_bit_for_bit(saved, small_sizes) -> None:
    loaded, model = load_checkpoint(saved), build_network(small_sizes, seed=3)
    assert loaded.config == small_sizes
    assert not loaded.training
    expected = model.state_dict()
    assert loaded.state_dict().keys() == expected.keys()
    assert all(torch.equal(tensor, expected[name]) for name, tensor in loaded.state_dict().items())


@pytest.mark.parametrize("name", ["nano", "midas-nano"])
@pytest.mark.slow
def test_a_loaded_network_is_complete_constants_and_frozen_weights_included(name: str, tmp_path) -> None:
    sizes = preset(name)
    sizes = replace(sizes, prompt=replace(sizes.prompt, train_words=False, trained_layers=1))
    model = build_network(sizes, seed=1)
    save_checkpoint(model, tmp_path / "checkpoint")
    loaded = load_checkpoint(tmp_path / "checkpoint")
    buffers = dict(loaded.named_buffers())
    assert buffers.keys() == dict(model.named_buffers()).keys()
    assert all(torch.equal(buffers[name], buffer) for name, buffer in model.named_buffers())
    kinds = [
        {name: (p.shape, p.dtype, p.device, p.requires_grad) for name, p in network.named_parameters()}
        for network in (loaded, model)
    ]
    assert kinds[0] == kinds[1]


def test_loading_draws_no_weights(saved, monkeypatch) -> None:
    def refuse(*arguments, **options):
        raise AssertionError("weights were drawn")

    before = torch.random.get_rng_state()
    monkeypatch.setattr(torch.Tensor, "uniform_", refuse)
    monkeypatch.setattr(torch.Tensor, "normal_", refuse)
    load_checkpoint(saved)
    assert torch.equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
def test_weights_are_stored_in_float32_unless_asked(dtype, small_sizes, tmp_path) -> None:
    model = build_network(small_sizes, seed=0).to(dtype)
    save_checkpoint(model, tmp_path / "float32")
    save_checkpoint(model, tmp_path / "asked", dtype=dtype)
    plain, asked = load_checkpoint(tmp_path / "float32"), load_checkpoint(tmp_path / "asked")
    assert {tensor.dtype for tensor in plain.state_dict().values()} == {torch.float32}
    assert {tensor.dtype for tensor in [*asked.parameters(), *asked.buffers()]} == {dtype}
    for name, tensor in model.state_dict().items():
        assert torch.equal(asked.state_dict()[name], tensor)
        assert torch.equal(plain.state_dict()[name], tensor.float())


def test_float16_is_for_files_only_and_read_as_float32(small_sizes, tmp_path) -> None:
    model = build_network(small_sizes, seed=0)
    save_checkpoint(model, tmp_path / "half", dtype=torch.float16)
    stored = load_file(tmp_path / "half" / WEIGHTS_FILE)
    assert {tensor.dtype for tensor in stored.values()} == {torch.float16}
    loaded = load_checkpoint(tmp_path / "half")
    assert {tensor.dtype for tensor in [*loaded.parameters(), *loaded.buffers()]} == {torch.float32}
    for name, tensor in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor.half().float())
    constants = dict(loaded.named_buffers())  # those that no file holds are not rounded
    assert all(
        torch.equal(constants[name], buffer) for name, buffer in model.named_buffers() if name not in stored
    )


def test_weights_beyond_the_range_of_float16_are_not_written(small_sizes, tmp_path) -> None:
    model = build_network(small_sizes, seed=0)
    with torch.no_grad():
        model.observation_out.weight[0, 0] = -7e4
    with pytest.raises(InputFileError, match="weights that are not finite: observation_out"):
        save_checkpoint(model, tmp_path / "checkpoint", dtype=torch.float16)
    assert not list(tmp_path.iterdir())
    save_checkpoint(model, tmp_path / "checkpoint")


def test_a_checkpoint_is_replaced_as_a_whole_or_not_at_all(saved, small_sizes, tmp_path, monkeypatch) -> None:
    before = {file.name: file.read_bytes() for file in saved.rglob("*.*")}

    def fail(*arguments, **options):
        raise OSError("disk is full")

    monkeypatch.setattr(checkpoint.yaml, "safe_dump", fail)  # the weights have been written by then
    with pytest.raises(OSError, match="disk is full"):
        save_checkpoint(build_network(small_sizes, seed=4), saved)
    assert {file.name: file.read_bytes() for file in saved.rglob("*.*")} == before
    assert [path.name for path in tmp_path.iterdir()] == [saved.name]


def test_a_checkpoint_whose_replacement_never_came_is_found(saved) -> None:
    saved.rename(saved.with_name(f".{saved.name}.old"))
    load_checkpoint(saved)
    assert saved.is_dir()


def test_a_folder_with_other_files_is_not_replaced(saved, small_sizes) -> None:
    (saved / "optimizer.safetensors").touch()
    with pytest.raises(InputFileError, match=r"other files than a checkpoint \(optimizer\.safetensors\)"):
        save_checkpoint(build_network(small_sizes, seed=4), saved)
    load_checkpoint(saved)


def test_every_kind_of_problem_is_in_one_message_and_nothing_is_loaded(small_sizes) -> None:
    model = build_network(small_sizes, seed=0)
    before = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    weights = {name: tensor + 1 for name, tensor in before.items()}
    del weights["query"]
    weights["surplus"] = torch.zeros(2)
    weights["end_effectors.weight"] = torch.zeros(3, 2)
    weights["observation_out.bias"] = weights["observation_out.bias"].int()
    with pytest.raises(InputFileError) as caught:
        load_weights(model, weights, source="here")
    message = str(caught.value)
    for part in (
        "here does not fit",
        "missing: query",
        "unexpected: surplus",
        "end_effectors.weight is float32 (3, 2) instead of float32 (2, 2)",
        "observation_out.bias is int32",
    ):
        assert part in message
    assert "\n" not in message
    assert all(torch.equal(tensor, before[name]) for name, tensor in model.state_dict().items())


@pytest.mark.parametrize("kept", [0, 1000, -1])
def test_a_truncated_file_is_named_as_damaged(saved, kept: int) -> None:
    file = saved / WEIGHTS_FILE
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(InputFileError, match=r"model\.safetensors is damaged"):
        load_checkpoint(saved)


@pytest.mark.parametrize("name", [WEIGHTS_FILE, CONFIG_FILE])
def test_a_missing_file_is_named(saved, name: str) -> None:
    (saved / name).unlink()
    with pytest.raises(InputFileError, match=f"it holds no {name}"):
        load_policy(str(saved))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "no valid YAML"),
        ("", "does not describe"),
        ("policy: gato\nconfig: {}\n", "does not describe a 'network' policy"),
        ("policy: network\nconfig: 3\n", "must be a mapping"),
        ("policy: network\nconfig: {}\n", "no architecture 'None'"),
        ("policy: network\nconfig: {architecture: vima}\n", "missing 4 required"),
        ("a: " + "x" * 70_000, "more than 65,536 bytes"),
        ("a: 2026-13-77", "no valid YAML"),
        ("a: !!python/object/apply:os.mkdir [executed]\n", "no valid YAML"),
        ("1: 3\n", "does not describe a 'network' policy"),
        ("a: \udcff", "no UTF-8"),
    ],
    ids=lambda value: ascii(value)[:24],
)
def test_a_config_of_anything_else_is_refused(saved, text: str, message: str) -> None:
    (saved / CONFIG_FILE).write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputFileError, match=message) as caught:
        load_checkpoint(saved)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


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
    (checkpoints / BEST_FILE).unlink()
    for name in ("2-cloning-999000", "2-cloning-1000000", "1-pretraining-2000000"):
        (checkpoints / name).mkdir()
    assert checkpoint_folder(tmp_path).name == "2-cloning-1000000"


def test_a_folder_or_run_without_a_checkpoint_is_refused(tmp_path) -> None:
    for _ in range(2):
        with pytest.raises(InputFileError, match="no checkpoint"):
            load_policy(str(tmp_path))
        (tmp_path / CHECKPOINTS_FOLDER).mkdir(exist_ok=True)


@pytest.fixture
def published(tmp_path) -> Path:
    """A published file of a small network."""
    return write_published(build_network(small_vima(), seed=0), tmp_path / "policy.ckpt")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
@pytest.mark.parametrize("name", [CONFIG_FILE, WEIGHTS_FILE])
def test_a_pipe_is_refused_and_not_waited_for(saved, name: str) -> None:
    (saved / name).unlink()
    os.mkfifo(saved / name)
    with pytest.raises(InputFileError, match=f"{name}.* no regular file"):
        load_checkpoint(saved)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_a_published_file_that_is_a_pipe_or_device_is_refused(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe.ckpt")
    for file in (tmp_path / "pipe.ckpt", Path("/dev/zero")):
        with pytest.raises(InputFileError, match="no regular file"):
            load_published(file)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("decoder.num_layers", 10**9, "between 0 and 128"),
        ("decoder.width", 2**40, "between 0 and 16384"),
        ("prompt.vocabulary_size", 10**12, "between 0 and 1000000"),
        ("decoder.dropout", float("nan"), "dropout is nan; it must be between"),
        ("prompt.train_words", "yes", "true or false"),
        ("prompt.text.num_heads", 0, "describes no network|does not fit"),
        ("images.crop.width", [1] * 900, "whole number"),
    ],
)
def test_sizes_beyond_all_reason_are_refused_before_anything_is_built(
    saved, path: str, value: object, message: str
) -> None:
    values = yaml.safe_load((saved / CONFIG_FILE).read_text())
    *parents, last = path.split(".")
    section = values["config"]
    for name in parents:
        section = section[name]
    section[last] = value
    (saved / CONFIG_FILE).write_text(yaml.safe_dump(values))
    with pytest.raises(InputFileError, match=message) as caught:
        load_checkpoint(saved)
    assert len(str(caught.value)) < 1000


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(saved, published, value: float) -> None:
    weights = load_file(saved / WEIGHTS_FILE)
    weights["query"][..., 0] = value
    save_file(weights, saved / WEIGHTS_FILE)
    with pytest.raises(InputFileError, match="not finite: query"):
        load_checkpoint(saved)
    contents = torch.load(published, weights_only=True)
    contents["state_dict"]["policy.end_effector_encoder.weight"][0, 0] = value
    torch.save(contents, published)
    with pytest.raises(InputFileError, match="not finite: "):
        load_published(published)


def test_a_compressed_archive_is_refused_before_it_is_unpacked(published) -> None:
    with zipfile.ZipFile(published) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(published, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(name, bytes(10_000_000) if Path(name).stem == "0" else content)
    with pytest.raises(InputFileError, match="is a compressed zip archive"):
        load_published(published)
