"""Build networks from their configs."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from openvima.policies.architectures import Flamingo, Gato, Gpt, Midas, Vima
from openvima.policies.config import PolicyConfig, check_limits
from openvima.policies.nn.layers import MetaInit
from openvima.policies.nn.policy_network import PolicyNetwork
from openvima.policies.pointer.model import Pointer

MODELS: dict[str, type[PolicyNetwork]] = {
    "vima": Vima,
    "gato": Gato,
    "flamingo": Flamingo,
    "gpt": Gpt,
    "midas": Midas,
    "pointer": Pointer,
}


def build_network(config: PolicyConfig, *, seed: int) -> PolicyNetwork:
    """Build a network with fresh weights from a seed, leaving the global random state unchanged."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return MODELS[config.architecture](config)


def outline_network(config: PolicyConfig) -> PolicyNetwork:
    """Build a network on the meta device, to count parameters or to assign weights.

    It allocates no memory. `network.load_state_dict(weights, assign=True)` makes it usable.

    Raises:
        ConfigError: A size lies beyond its limit.
    """
    check_limits(config, "policy")
    with MetaInit():
        return MODELS[config.architecture](config)


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
    "head": ("head.", "text_appearance."),
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


@dataclass(frozen=True, slots=True)
class PolicySize:
    """Size of a policy.

    Args:
        architecture: vima, gato, flamingo, gpt, midas or pointer.
        width: Width of the decoder.
        num_layers: Layers of the decoder: pairs of a cross block and a self block, or self blocks alone.
        num_heads: Heads of self-attention.
        parts: Parameters of each of `PARTS`.
    """

    architecture: str
    width: int
    num_layers: int
    num_heads: int
    parts: Mapping[str, Count]

    @property
    def parameters(self) -> Count:
        """Parameters of all parts."""
        counts = self.parts.values()
        return Count(sum(count.trainable for count in counts), sum(count.frozen for count in counts))


def policy_size(config: PolicyConfig) -> PolicySize:
    """Count the parameters of a network without allocating it."""
    decoder = config.decoder
    return PolicySize(
        architecture=config.architecture,
        width=decoder.width,
        num_layers=decoder.num_layers,
        num_heads=decoder.num_heads,
        parts=count_parameters(outline_network(config)),
    )


def count_parameters(network: PolicyNetwork) -> dict[str, Count]:
    """Count the parameters of each part."""
    counts = dict.fromkeys(PARTS, Count())
    for name, parameter in network.named_parameters():
        part = next(part for part, prefixes in PARTS.items() if name.startswith(prefixes))
        number, count = parameter.numel(), counts[part]
        if parameter.requires_grad:
            counts[part] = Count(count.trainable + number, count.frozen)
        else:
            counts[part] = Count(count.trainable, count.frozen + number)
    return counts
