"""How many parameters a policy has, part by part."""

from collections.abc import Mapping
from dataclasses import dataclass

from openvima.policies.config import PolicyConfig
from openvima.policies.network import PolicyNetwork, outline_network
from openvima.policies.nn.frame_encoder import FrameEncoderConfig
from openvima.policies.nn.trunk import DecoderConfig

# Part → where its parameters are. The published names of sizes, such as 200M, count the trunk alone.
PARTS = {
    "prompt": ("prompt.",),
    "images": ("images.", "end_effectors.", "observation_out.", "compare_"),
    "trunk": ("trunk.self_blocks.", "trunk.cross_blocks."),
    "actions": ("actions.",),
    "head": ("head.", "word_looks."),
    "positions": ("trunk.positions.", "trunk.prompt_positions.", "trunk.separator", "query"),
}

_FAMILIES = {"patches": "gato", "resampled": "flamingo", "class": "gpt"}  # by what becomes of frames


@dataclass(frozen=True, slots=True)
class Count:
    """Numbers of parameters.

    Args:
        trainable: Those that training changes.
        frozen: Those that it leaves as they are.
    """

    trainable: int = 0
    frozen: int = 0

    @property
    def total(self) -> int:
        """All of them."""
        return self.trainable + self.frozen


@dataclass(frozen=True, slots=True)
class PolicySize:
    """How large a policy is.

    Args:
        family: vima, gato, flamingo, gpt or midas.
        width: Width of the trunk.
        num_layers: Layers of the trunk: pairs of a cross block and a self block, or self blocks alone.
        num_heads: Heads of self-attention.
        parts: Parameters of each of `PARTS`.
    """

    family: str
    width: int
    num_layers: int
    num_heads: int
    parts: Mapping[str, Count]

    @property
    def whole(self) -> Count:
        """Parameters of all parts together."""
        counts = self.parts.values()
        return Count(sum(count.trainable for count in counts), sum(count.frozen for count in counts))


def policy_size(config: PolicyConfig) -> PolicySize:
    """Count the parameters that a network of these sizes has; none is made for it."""
    trunk = config.trunk
    return PolicySize(
        family=_family(config),
        width=trunk.width,
        num_layers=trunk.num_layers,
        num_heads=trunk.num_self_heads if isinstance(trunk, DecoderConfig) else trunk.num_heads,
        parts=count_parameters(outline_network(config)),
    )


def _family(config: PolicyConfig) -> str:
    if isinstance(config.images, FrameEncoderConfig):
        return _FAMILIES[config.images.readout]
    return "vima" if isinstance(config.trunk, DecoderConfig) else "midas"


def count_parameters(network: PolicyNetwork) -> dict[str, Count]:
    """Count the parameters of each part."""
    counts = {}
    for part, places in PARTS.items():
        found = [parameter for name, parameter in network.named_parameters() if name.startswith(places)]
        trainable = sum(parameter.numel() for parameter in found if parameter.requires_grad)
        counts[part] = Count(trainable, sum(parameter.numel() for parameter in found) - trainable)
    return counts
