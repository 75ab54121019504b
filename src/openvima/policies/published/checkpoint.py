"""Load published checkpoint files without executing code from them."""

from collections.abc import Mapping
from pathlib import Path
from reprlib import repr as short
from typing import Any

import torch

from openvima.errors import CheckpointError, ConfigError, InputFileError
from openvima.policies.build import outline_network
from openvima.policies.differences import described, listed
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.published.config import config_from_published
from openvima.policies.published.names import from_published, is_unused, to_published, without_prefix
from openvima.policies.tensor_files import check_finite, read_archive

_MAX_LISTED = 20  # names that a message lists per kind of problem


def load_published(file: str | Path) -> PolicyNetwork:
    """Load a network from a published file, such as `2M.ckpt`.

    Args:
        file: A torch archive that holds `state_dict` and `cfg`, of VIMA or one of its baselines. Unused
            entries are optional.

    Returns:
        The network, in float32 and in evaluation mode.

    Raises:
        CheckpointError: The file is missing, damaged or of another format, it would execute code, or its
            weights do not match its `cfg`. One message lists missing and unexpected names and wrong shapes,
            up to 20 of each.
    """
    file = Path(file)
    if not file.exists() or file.is_dir():
        raise CheckpointError(f"{file} is no file. A published checkpoint is a single file such as 2M.ckpt.")
    try:
        weights, cfg = _contents(file, read_archive(file))
    except InputFileError as error:
        raise CheckpointError(str(error)) from error
    try:
        network = outline_network(config_from_published(weights, cfg))
        _check_fit(network, weights)
        network.load_state_dict(from_published(weights), assign=True)
    except (CheckpointError, ConfigError) as error:
        raise CheckpointError(f"{file}: {error}") from error
    except (TypeError, ValueError, LookupError, ArithmeticError, RuntimeError) as error:
        # Sizes within their limits can contradict each other in many ways.
        raise CheckpointError(f"{file} describes no network: {error}") from error
    check_finite(network.state_dict(), file)
    return network.eval()


def _contents(file: Path, values: Any) -> tuple[Mapping[str, torch.Tensor], Mapping[str, object]]:
    # Any: whatever the file holds
    if not isinstance(values, Mapping) or any(
        not isinstance(values.get(name), Mapping) for name in ("state_dict", "cfg")
    ):
        keys = [short(key).strip("'") for key in values] if isinstance(values, Mapping) else []
        found = listed("the keys", keys, limit=_MAX_LISTED) or [f"a {type(values).__name__}"]
        raise CheckpointError(
            f"{file} holds {found[0]}; a published checkpoint holds the mappings state_dict and cfg. "
            "The number of heads cannot be inferred from weights alone."
        )
    weights = values["state_dict"]
    others = [
        short(name).strip("'")
        for name, value in weights.items()
        if not isinstance(value, torch.Tensor) or not isinstance(name, str)
    ]
    if others:
        raise CheckpointError(
            f"{file}: state_dict holds more than weights: {', '.join(others[:_MAX_LISTED])}."
        )
    return weights, values["cfg"]


def _check_fit(network: PolicyNetwork, weights: Mapping[str, torch.Tensor]) -> None:
    """Compare published names and shapes with what the network expects."""
    expected = to_published(network)
    given = {name: tensor for name, tensor in without_prefix(weights).items() if not is_unused(name)}
    wrong = [
        f"{name} is {described(given[name].dtype, given[name].shape)} instead of "
        f"{described(wanted.dtype, wanted.shape)}"
        for name, wanted in expected.items()
        if name in given and (given[name].shape != wanted.shape or not given[name].is_floating_point())
    ]
    problems = [
        *listed("missing", [name for name in expected if name not in given], limit=_MAX_LISTED),
        *listed("unexpected", [name for name in given if name not in expected], limit=_MAX_LISTED),
        *listed("wrong", wrong, limit=_MAX_LISTED),
    ]
    if problems:
        raise CheckpointError(f"the weights do not fit the network of their cfg: {'; '.join(problems)}.")
