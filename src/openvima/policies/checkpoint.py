"""Checkpoints: weights in `model.safetensors`, sizes in `config.yaml` beside them."""

from pathlib import Path
from typing import Any

import torch
import yaml
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from openvima import __version__
from openvima.errors import CheckpointError, ConfigError
from openvima.policies.acting import NetworkPolicy
from openvima.policies.base import checkpoint_folder
from openvima.policies.config import PolicyConfig
from openvima.policies.network import PolicyNetwork, build_network

WEIGHTS_FILE = "model.safetensors"
CONFIG_FILE = "config.yaml"
_KIND = "network"
_SHOWN = 5  # names of each kind of problem that a message lists


def save_checkpoint(model: PolicyNetwork, folder: Path) -> None:
    """Write weights and sizes into an existing folder."""
    tensors = {name: tensor.detach().contiguous().cpu() for name, tensor in model.state_dict().items()}
    save_file(tensors, folder / WEIGHTS_FILE)
    text = yaml.safe_dump(
        {"policy": _KIND, "openvima": __version__, "config": model.config.to_dict()}, sort_keys=False
    )
    (folder / CONFIG_FILE).write_text(text, encoding="utf-8")


def load_checkpoint(folder: Path) -> PolicyNetwork:
    """Read a network from a checkpoint folder.

    Args:
        folder: Holds `model.safetensors` and `config.yaml`.

    Returns:
        The network, in evaluation mode.

    Raises:
        CheckpointError: A file is missing or unreadable, or weights and sizes do not fit.
    """
    config = _read_config(folder / CONFIG_FILE)
    tensors = _read_weights(folder / WEIGHTS_FILE)
    model = build_network(config, seed=0)
    load_weights(model, tensors, source=str(folder / WEIGHTS_FILE))
    return model.eval()


def load_pretrained(path_or_hub_id: str | Path, **options: Any) -> NetworkPolicy:  # Any: of several kinds
    """Load a policy.

    Args:
        path_or_hub_id: A folder that `save_pretrained` or `openvima train` wrote (of a run the best
            checkpoint is taken), or an id on the Hugging Face Hub such as "name/policy".
        **options: Of `NetworkPolicy`, such as `device`, `dtype` or `temperature`.

    Raises:
        CheckpointError: There is no such folder, or it holds no checkpoint that can be read.
    """
    folder = checkpoint_folder(Path(path_or_hub_id))
    return NetworkPolicy(load_checkpoint(folder), **options)


def save_pretrained(policy: NetworkPolicy, folder: str | Path) -> None:
    """Write a policy into a folder, which `load_pretrained` reads; in float32, whatever it computes in."""
    save_checkpoint(policy.network, Path(folder))


def load_weights(model: PolicyNetwork, tensors: dict[str, torch.Tensor], *, source: str) -> None:
    """Copy weights into a network.

    Raises:
        CheckpointError: Names, shapes or dtypes differ; one message tells all of them.
    """
    expected = model.state_dict()
    problems = _listed("missing", [name for name in expected if name not in tensors])
    problems += _listed("unexpected", [name for name in tensors if name not in expected])
    differing = [
        f"{name} is {_described(tensors[name])} instead of {_described(wanted)}"
        for name, wanted in expected.items()
        if name in tensors and (tensors[name].shape, tensors[name].dtype) != (wanted.shape, wanted.dtype)
    ]
    problems += _listed("wrong", differing)
    if problems:
        raise CheckpointError(
            f"{source} does not fit the network of its {CONFIG_FILE}: {'; '.join(problems)}. "
            "Use the config that was written with the weights."
        )
    model.load_state_dict(tensors)


def _read_config(file: Path) -> PolicyConfig:
    if not file.is_file():
        raise CheckpointError(f"{file.parent} is no checkpoint: it holds no {CONFIG_FILE}.")
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise CheckpointError(f"{file} is no valid YAML: {error}") from error
    if not isinstance(values, dict) or values.get("policy") != _KIND or "config" not in values:
        raise CheckpointError(f"{file} does not describe a {_KIND!r} policy.")
    try:
        return PolicyConfig.from_dict(values["config"])
    except ConfigError as error:
        raise CheckpointError(f"{file}: {error}") from error


def _read_weights(file: Path) -> dict[str, torch.Tensor]:
    if not file.is_file():
        raise CheckpointError(f"{file.parent} is no checkpoint: it holds no {WEIGHTS_FILE}.")
    try:
        return load_file(file)
    except SafetensorError as error:
        raise CheckpointError(f"{file} is damaged ({error}). Take another checkpoint of the run.") from error


def _listed(what: str, names: list[str]) -> list[str]:
    if not names:
        return []
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return [f"{what}: {', '.join(names[:_SHOWN])}{more}"]


def _described(tensor: torch.Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {tuple(tensor.shape)}"
