"""Checkpoints: a folder with weights, config and tokenizer.

model.safetensors    weights
config.yaml          config of the network, precision of the weights
tokenizer/           the vocabulary, or the files of the T5 tokenizer
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from reprlib import repr as short

import torch
import yaml

from openvima import __version__
from openvima.atomic_io import atomic_folder, atomic_write_file, restore_folder
from openvima.errors import ConfigError, InputFileError
from openvima.input_files import as_path
from openvima.policies.build import PolicyConfig, config_from_dict, config_to_dict, outline_network
from openvima.policies.naming import CONFIG_FILE, TOKENIZER_FOLDER, WEIGHTS_FILE, find_checkpoint
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.published import load_published
from openvima.policies.t5 import T5Tokenizer, tokenizer_for
from openvima.policies.tensor_files import (
    check_finite,
    check_replaceable,
    described,
    file_digest,
    mismatches,
    read_description,
    read_safetensors,
    write_safetensors,
)
from openvima.policies.tokenizer import Tokenizer, WordTokenizer

_KIND = "network"
_PRECISIONS = ("float32", "bfloat16", "float16", "float64")


@dataclass(frozen=True, slots=True)
class CheckpointInfo:
    """Contents of `config.yaml`.

    Args:
        config: Config of the network.
        dtype: Precision of the stored weights.
        digest: Of the file of weights; "" if it is not recorded.
    """

    config: PolicyConfig
    dtype: torch.dtype
    digest: str = ""


def save_checkpoint(
    network: PolicyNetwork,
    folder: str | Path,
    tokenizer: Tokenizer | None = None,
    *,
    dtype: torch.dtype = torch.float32,
) -> None:
    """Write a checkpoint folder atomically, replacing an existing checkpoint.

    Args:
        network: The network.
        folder: The folder; it must not exist, be empty, or be a checkpoint.
        tokenizer: Stored beside the weights, unless it is one of your own. Networks with a vocabulary have
            that of the benchmark by default.
        dtype: Precision of the stored weights: float32, bfloat16, float16 or float64, independent of the
            network's own. float16 halves the file size and rounds less than bfloat16; such weights are
            loaded as float32.

    Raises:
        InputFileError: The folder holds other files, the precision is not supported, or a weight overflows
            it.
    """
    folder = as_path(folder)
    check_replaceable(folder, (WEIGHTS_FILE, CONFIG_FILE, TOKENIZER_FOLDER))
    with atomic_folder(folder) as partial:
        write_checkpoint(network, partial, tokenizer, dtype=dtype)


def write_checkpoint(
    network: PolicyNetwork,
    folder: Path,
    tokenizer: Tokenizer | None = None,
    *,
    dtype: torch.dtype = torch.float32,
) -> None:
    """Write the files of a checkpoint into a partial folder; see `save_checkpoint`."""
    precision = described(dtype)
    if precision not in _PRECISIONS:
        raise InputFileError(f"weights cannot be stored in {precision}; allowed: {', '.join(_PRECISIONS)}.")
    weights = network.state_dict().items()
    tensors = {name: tensor.detach().to("cpu", dtype).contiguous() for name, tensor in weights}
    check_finite(tensors, folder / WEIGHTS_FILE)  # as beyond the range of float16
    write_safetensors(tensors, folder / WEIGHTS_FILE)
    values = {
        "policy": _KIND,
        "openvima": __version__,
        "precision": precision,
        "digest": file_digest(folder / WEIGHTS_FILE),
        "config": config_to_dict(network.config),
    }
    atomic_write_file(folder / CONFIG_FILE, yaml.safe_dump(values, sort_keys=False))
    if tokenizer is None and network.config.prompt.tokenizer == "words":
        tokenizer = tokenizer_for(network.config.prompt)
    if isinstance(tokenizer, T5Tokenizer | WordTokenizer):
        tokenizer.save(folder / TOKENIZER_FOLDER)


def load_checkpoint(folder: str | Path) -> PolicyNetwork:
    """Load a network from a checkpoint folder.

    The weights are memory-mapped: the file may be replaced or deleted, but must not be modified in place.

    Args:
        folder: Holds `model.safetensors` and `config.yaml`.

    Returns:
        The network in evaluation mode, in the precision of the stored weights, or in float32 for float16.

    Raises:
        InputFileError: A file is missing or unreadable, or weights and config do not match.
    """
    folder = as_path(folder)
    restore_folder(folder)
    info = read_info(folder)
    try:
        network = outline_network(info.config)
    except MemoryError:
        raise
    except Exception as error:  # sizes within their limits can contradict each other in many ways
        raise InputFileError(f"{folder / CONFIG_FILE} describes no network: {error}") from error
    file = folder / WEIGHTS_FILE
    if not file.exists():
        raise InputFileError(f"{folder} is no checkpoint: it holds no {WEIGHTS_FILE}.")
    tensors = read_safetensors(file)
    _check(network, tensors, source=str(file))
    if info.digest and info.digest != file_digest(file):
        raise InputFileError(
            f"{file} is damaged: its digest is not the one in {CONFIG_FILE}. Take another checkpoint, or "
            "delete the line `digest` if you changed the weights on purpose."
        )
    # The range of float16 is too narrow to compute in.
    dtype = torch.float32 if info.dtype == torch.float16 else info.dtype
    network.load_state_dict({name: tensor.to(dtype) for name, tensor in tensors.items()}, assign=True)
    return network.to(dtype).eval()  # buffers, too


def read_info(folder: Path) -> CheckpointInfo:
    """Read the config of a checkpoint without its weights.

    Raises:
        InputFileError: The config is missing or invalid.
    """
    file, values = folder / CONFIG_FILE, read_description(folder, _KIND)
    precision = values.get("precision", "float32")
    if precision not in _PRECISIONS:
        raise InputFileError(f"{file}: precision is {short(precision)}; allowed: {', '.join(_PRECISIONS)}.")
    try:
        config = config_from_dict(values["config"])
        return CheckpointInfo(config, getattr(torch, precision), str(values.get("digest", "")))
    except ConfigError as error:
        raise InputFileError(f"{file}: {error}") from error


def load_network(path_or_hub_id: str | Path) -> tuple[PolicyNetwork, Path | None]:
    """Load a network from a path, the name of a bundled checkpoint or a Hub id; see `find_checkpoint`.

    Returns:
        The network, and the folder of its stored tokenizer; None if it uses T5 and that is not stored.

    Raises:
        InputFileError: There is no such folder, or it holds no readable checkpoint.
    """
    found = find_checkpoint(path_or_hub_id)
    if found.is_file():
        return load_published(found), None
    network, tokenizer = load_checkpoint(found), found / TOKENIZER_FOLDER
    is_needed = network.config.prompt.tokenizer == "words"
    return network, tokenizer if is_needed or tokenizer.is_dir() else None


def load_weights(model: PolicyNetwork, tensors: Mapping[str, torch.Tensor], *, source: str) -> None:
    """Copy weights into a network.

    Raises:
        InputFileError: Names, shapes or dtypes differ; one message lists all differences.
    """
    _check(model, tensors, source=source)
    model.load_state_dict(tensors)


def _check(network: PolicyNetwork, tensors: Mapping[str, torch.Tensor], *, source: str) -> None:
    if problems := mismatches(tensors, network.state_dict()):
        raise InputFileError(
            f"{source} does not fit the network of its {CONFIG_FILE}: {'; '.join(problems)}. "
            "Use the config that was written with the weights."
        )
