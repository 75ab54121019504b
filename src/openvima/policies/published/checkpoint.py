"""Load published checkpoint files without executing code from them."""

import pickle
import re
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from openvima.errors import CheckpointError
from openvima.policies.build import outline_network
from openvima.policies.differences import described, listed
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.published.config import config_from_published
from openvima.policies.published.names import from_published, is_unused, to_published, without_prefix

_ZIP_START = b"PK\x03\x04"
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
    weights, cfg = _contents(file, _unpickled(file))
    try:
        network = outline_network(config_from_published(weights, cfg))
        _check_fit(network, weights)
        network.load_state_dict(from_published(weights), assign=True)
    except CheckpointError as error:
        raise CheckpointError(f"{file}: {error}") from error
    return network.eval()


def _unpickled(file: Path) -> Any:  # Any: whatever the file holds
    _check_archive(file)
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # a malicious file can fail in any way
        raise CheckpointError(f"{file} {_refusal(error)}") from error


def _refusal(error: Exception) -> str:
    wanted = re.search(r"GLOBAL (\S+)", str(error)) if isinstance(error, pickle.UnpicklingError) else None
    if wanted:
        return (
            f"wants {wanted[1]} to be loaded, which could execute code. Nothing was executed. Published "
            "checkpoints hold nothing but tensors and numbers; take the file from where they are published."
        )
    reason = (str(error).splitlines() or [""])[0]
    return f"is a zip archive, but no torch checkpoint ({type(error).__name__}: {reason})."


def _check_archive(file: Path) -> None:
    """Reject incomplete or damaged zip archives; torch itself does not detect damaged weights."""
    if not file.is_file():
        raise CheckpointError(f"{file} is no file. A published checkpoint is a single file such as 2M.ckpt.")
    if not zipfile.is_zipfile(file):
        with file.open("rb") as stream:
            is_cut = stream.read(len(_ZIP_START)) == _ZIP_START
        raise CheckpointError(
            f"{file} ends too early (interrupted download?). Download it again."
            if is_cut
            else f"{file} is no published checkpoint, which would be a torch zip archive."
        )
    try:
        with zipfile.ZipFile(file) as archive:
            damaged = archive.testzip()
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError) as error:
        raise CheckpointError(f"{file} is damaged ({error}). Download it again.") from error
    if damaged is not None:
        raise CheckpointError(f"{file} is damaged (in its entry {damaged}). Download it again.")


def _contents(file: Path, values: Any) -> tuple[Mapping[str, torch.Tensor], Mapping[str, object]]:
    # Any: whatever the file holds
    if not isinstance(values, Mapping) or any(
        not isinstance(values.get(name), Mapping) for name in ("state_dict", "cfg")
    ):
        keys = list(map(str, values)) if isinstance(values, Mapping) else []
        found = listed("the keys", keys, limit=_MAX_LISTED) or [f"a {type(values).__name__}"]
        raise CheckpointError(
            f"{file} holds {found[0]}; a published checkpoint holds the mappings state_dict and cfg. "
            "The number of heads cannot be inferred from weights alone."
        )
    weights = values["state_dict"]
    others = [str(name) for name, value in weights.items() if not isinstance(value, torch.Tensor)]
    if others or not all(isinstance(name, str) for name in weights):
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
