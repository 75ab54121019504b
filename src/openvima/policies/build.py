"""All architectures: their configs as plain values, networks from them, and counts of parameters."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from reprlib import repr as short
from typing import Any, get_args

import torch

from openvima.errors import ConfigError, unknown_name
from openvima.policies.architectures import Architecture, TokenPolicy, TokenPolicyConfig
from openvima.policies.config_fields import build_config, check_limits
from openvima.policies.nn.layers import MetaInit
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.pointer.config import PointerConfig
from openvima.policies.pointer.model import Pointer

PolicyConfig = TokenPolicyConfig | PointerConfig


def config_to_dict(config: PolicyConfig) -> dict[str, Any]:
    """Convert to nested dictionaries of plain values, the architecture first."""
    return {"architecture": config.architecture, **asdict(config)}


def config_from_dict(values: Mapping[str, Any]) -> PolicyConfig:
    """Inverse of `config_to_dict`.

    Raises:
        ConfigError: A field is missing or unknown, or sizes are inconsistent.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(f"policy is {short(values)}; it must be a mapping of architecture and sizes.")
    architecture, of_tokens = values.get("architecture"), get_args(Architecture)
    if architecture not in (known := (*of_tokens, PointerConfig.architecture)):
        raise ConfigError(unknown_name("architecture", short(architecture).strip("'"), known))
    if architecture in of_tokens:
        return build_config(TokenPolicyConfig, values, "policy")
    sizes = {name: value for name, value in values.items() if name != "architecture"}
    return build_config(PointerConfig, sizes, "policy")


def build_network(config: PolicyConfig, *, seed: int) -> PolicyNetwork:
    """Build a network with fresh weights from a seed, leaving the global random state unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return _network(config)


def outline_network(config: PolicyConfig) -> PolicyNetwork:
    """Build a network on the meta device, to count parameters or to assign weights.

    It allocates no memory. `network.load_state_dict(weights, assign=True)` makes it usable.

    Raises:
        ConfigError: A size lies beyond its limit.
    """
    check_limits(config, "policy")
    with MetaInit():
        return _network(config)


def _network(config: PolicyConfig) -> PolicyNetwork:
    return Pointer(config) if isinstance(config, PointerConfig) else TokenPolicy(config)


# Part -> prefixes of its parameters; the first match counts. Published size names, such as 200M, count the
# decoder blocks only.
PARTS = {
    "prompt": ("prompt.", "coreference."),
    "images": (
        "images.",
        "resampler.",
        "end_effectors.",
        "observation_out.",
        "correspondence.",
        "prompt_correspondence.",
        "attributes.",
    ),
    "decoder": ("decoder.self_blocks.", "decoder.cross_blocks."),
    "actions": ("actions.", "head.actions."),
    "head": ("head.", "text_appearance.", "place_kinds"),
    "positions": ("decoder.positions.", "decoder.prompt_positions.", "decoder.separator", "query"),
}


@dataclass(frozen=True, slots=True)
class Count:
    """Parameter counts.

    Args:
        trainable: Updated in training.
        frozen: Not updated.
    """

    trainable: int = 0
    frozen: int = 0

    @property
    def total(self) -> int:
        """Trainable and frozen parameters."""
        return self.trainable + self.frozen


def count_parameters(network: PolicyNetwork) -> dict[str, Count]:
    """Count the parameters of each of `PARTS`, and of all as "total"; an outline has the same."""
    counts = dict.fromkeys((*PARTS, "total"), Count())
    for name, parameter in network.named_parameters():
        part = next(part for part, prefixes in PARTS.items() if name.startswith(prefixes))
        trained = parameter.numel() * parameter.requires_grad
        for key in (part, "total"):
            old = counts[key]
            counts[key] = Count(old.trainable + trained, old.frozen + parameter.numel() - trained)
    return counts
