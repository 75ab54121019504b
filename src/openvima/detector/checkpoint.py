"""Checkpoints of detectors: folders with `model.safetensors` and `config.yaml`."""

from collections.abc import Mapping
from pathlib import Path

import torch
import yaml

from openvima import __version__
from openvima.atomic_io import atomic_folder, atomic_write_file, restore_folder
from openvima.detector.config import DetectorConfig
from openvima.detector.network import MaskRCNN
from openvima.errors import ConfigError, InputFileError
from openvima.policies.naming import CONFIG_FILE, WEIGHTS_FILE, checkpoint_folder
from openvima.policies.nn.layers import MetaInit
from openvima.policies.tensor_files import (
    check_replaceable,
    mismatches,
    read_description,
    read_safetensors,
    write_safetensors,
)

_KIND = "detector"
_MAX_LISTED = 5  # names per kind of problem in a message
_COUNTER = "num_batches_tracked"  # of batch normalisation; unused


def save_network(network: MaskRCNN, folder: str | Path) -> None:
    """Write a checkpoint folder atomically; an existing checkpoint is replaced.

    Raises:
        InputFileError: The folder contains other files.
    """
    folder = Path(folder)
    check_replaceable(folder, (WEIGHTS_FILE, CONFIG_FILE))
    with atomic_folder(folder) as partial:
        write_network(network, partial)


def write_network(network: MaskRCNN, folder: Path, weights: Mapping[str, torch.Tensor] | None = None) -> None:
    """Write the files of a checkpoint into an existing folder.

    Args:
        network: The network.
        folder: The folder.
        weights: State dict to write instead of the network's own.
    """
    weights = network.state_dict() if weights is None else weights
    tensors = {
        name: tensor.detach().cpu().contiguous()
        for name, tensor in weights.items()
        if not name.endswith(_COUNTER)
    }
    write_safetensors(tensors, folder / WEIGHTS_FILE)
    values = {"policy": _KIND, "openvima": __version__, "config": network.config.to_dict()}
    atomic_write_file(folder / CONFIG_FILE, yaml.safe_dump(values, sort_keys=False))


def load_network(path: str | Path) -> MaskRCNN:
    """Load a network in evaluation mode.

    Args:
        path: A checkpoint folder, or a run folder, whose best checkpoint is loaded.

    Raises:
        InputFileError: There is none, it is damaged, or weights and config do not match.
    """
    path = Path(path)
    restore_folder(path)
    folder = checkpoint_folder(path)
    file = folder / WEIGHTS_FILE
    return build_network(read_config(folder), read_safetensors(file), source=file)


def read_config(folder: Path) -> DetectorConfig:
    """Read the config of a checkpoint.

    Raises:
        InputFileError: There is no config, or it is invalid.
    """
    file, values = folder / CONFIG_FILE, read_description(folder, _KIND)
    try:
        return DetectorConfig.from_dict(values["config"])
    except ConfigError as error:
        raise InputFileError(f"{file}: {error}") from error


def load_weights(network: MaskRCNN, file: Path) -> None:
    """Load the weights of a file into a network.

    Raises:
        InputFileError: The file is missing or damaged, or names or shapes differ.
    """
    tensors = read_safetensors(file)
    _check(network, tensors, source=file)
    network.load_state_dict(tensors, strict=False)


def build_network(config: DetectorConfig, tensors: Mapping[str, torch.Tensor], *, source: Path) -> MaskRCNN:
    """Build a network of weights, in evaluation mode.

    Raises:
        InputFileError: Config and weights do not match, or describe no network.
    """
    try:
        with MetaInit():  # takes no memory, whatever the config says
            outline = MaskRCNN(config)
    except MemoryError:
        raise
    except Exception as error:  # sizes within their limits can contradict each other in many ways
        raise InputFileError(f"the config of {source} describes no network: {error}") from error
    _check(outline, tensors, source=source)
    network = MaskRCNN(config)
    network.load_state_dict(tensors, strict=False)
    return network.eval()


def _check(network: MaskRCNN, tensors: Mapping[str, torch.Tensor], *, source: Path) -> None:
    expected = {name: own for name, own in network.state_dict().items() if not name.endswith(_COUNTER)}
    given = {name: tensor for name, tensor in tensors.items() if not name.endswith(_COUNTER)}
    problems = mismatches(given, expected, limit=_MAX_LISTED)
    if problems:
        raise InputFileError(f"{source} does not match the config of the detector: {'; '.join(problems)}.")
