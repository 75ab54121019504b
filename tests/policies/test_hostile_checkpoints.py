"""Checkpoints made to harm: pipes, bombs, huge sizes, repeated values, weights that are not finite."""

import os
import zipfile
from pathlib import Path

import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from openvima.errors import InputFileError
from openvima.policies.build import build_network
from openvima.policies.checkpoint import load_checkpoint, save_checkpoint
from openvima.policies.naming import CONFIG_FILE, WEIGHTS_FILE
from openvima.policies.published import load_published
from published_policies import small_vima, write_published


@pytest.fixture
def saved(small_sizes, tmp_path) -> Path:
    """A checkpoint folder of a small network."""
    folder = tmp_path / "checkpoint"
    save_checkpoint(build_network(small_sizes, seed=3), folder)
    return folder


@pytest.fixture
def published(tmp_path) -> Path:
    """A published file of a small network."""
    return write_published(build_network(small_vima(), seed=0), tmp_path / "policy.ckpt")


def repacked(file: Path, method: int = zipfile.ZIP_STORED, **replaced: bytes) -> Path:
    """Write the archive again with some entries replaced, by the last part of their names."""
    with zipfile.ZipFile(file) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(file, "w", method) as archive:
        for name, content in entries.items():
            archive.writestr(name, replaced.get(Path(name).stem, content))
    return file


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
    ("text", "message"),
    [
        ("a: " + "x" * 70_000, "more than 65536 bytes"),
        ("a: 2026-13-77", "no valid YAML"),
        ("a: !!python/object/apply:os.mkdir [executed]\n", "no valid YAML"),
        ("1: 3\n", "does not describe a 'network' policy"),
        ("a: \udcff", "no UTF-8"),
    ],
    ids=["size", "no date", "code", "int key", "bytes"],
)
def test_a_config_of_more_than_plain_values_is_refused(saved, text: str, message: str) -> None:
    (saved / CONFIG_FILE).write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputFileError, match=message) as caught:
        load_checkpoint(saved)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("decoder.num_layers", 10**9, "between 0 and 128"),
        ("decoder.width", 2**40, "between 0 and 16384"),
        ("prompt.vocabulary_size", 10**12, "between 0 and 1000000"),
        ("decoder.num_layers", "many", "whole number"),
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
    repacked(published, zipfile.ZIP_DEFLATED, **{"0": bytes(10_000_000)})
    with pytest.raises(InputFileError, match="is a compressed zip archive"):
        load_published(published)


@pytest.mark.parametrize("name", ["builtins\nexec", "os\nmkdir", "torch\nload"])
def test_pickles_that_name_more_than_tensors_are_refused(published, name: str) -> None:
    repacked(published, data=b"\x80\x02c" + name.encode() + b"\nX\x01\0\0\0x\x85R.")
    with pytest.raises(InputFileError, match="Nothing was executed"):
        load_published(published)
