"""Variants of a network: the parts that the papers' ablations exchange, as functions on its config."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from openvima.errors import ConfigError, unknown_name
from openvima.policies.config import PolicyConfig
from openvima.policies.nn.autoregressive import AutoregressiveConfig
from openvima.policies.nn.decoder import DecoderConfig, PrefixDecoderConfig
from openvima.policies.nn.heads import HEADS
from openvima.policies.pointer.config import PointerConfig

CONDITIONINGS = ("cross-attention", "prefix")


def with_variant(config: PolicyConfig, switches: Mapping[str, Any]) -> PolicyConfig:  # Any: of several kinds
    """Return the same network with other parts.

    Args:
        config: The network.
        switches: Values of `SWITCHES` by name; None keeps the part.

    Raises:
        ConfigError: There is no such switch or value, or the network cannot have it.
    """
    for name in switches:
        if name not in SWITCHES:
            raise ConfigError(unknown_name("switch", name, SWITCHES))
    for name, switch in SWITCHES.items():
        if switches.get(name) is not None:
            config = switch(config, switches[name])
    return config


def with_head(config: PolicyConfig, name: str) -> PolicyConfig:
    """Return the same network with another action head of the same sizes.

    Args:
        config: The network.
        name: One of `openvima.policies.nn.heads.HEADS`.

    Raises:
        ConfigError: There is no such head, or the network is a pointer model.
    """
    if name not in HEADS:
        raise ConfigError(unknown_name("head", name, HEADS))
    if isinstance(config, PointerConfig):
        raise ConfigError(
            f"head is {name!r}, but pointer models choose among candidates; take nano-bins or another preset."
        )
    kind, head = HEADS[name], config.head
    if isinstance(head, kind):
        return config
    if kind is AutoregressiveConfig:
        new = AutoregressiveConfig(head.hidden_width, config.decoder.initial_std, head.action_width)
    else:
        new = kind(head.hidden_width, action_width=head.action_width)
    return replace(config, head=new)


def with_visual_residual(config: PolicyConfig, wanted: bool = True) -> PolicyConfig:
    """Return the same network with or without the visual residual in its prompt encoder."""
    return replace(config, prompt=replace(config.prompt, visual_residual=wanted))


def with_conditioning(config: PolicyConfig, name: str) -> PolicyConfig:
    """Return the same network with another prompt conditioning, in a decoder of about as many parameters.

    Args:
        config: The network.
        name: "cross-attention", or "prefix", the prompt before the history in one causal sequence. A layer
            of the former is a pair of blocks, so the latter has twice as many layers.

    Raises:
        ConfigError: There is no such conditioning, or the network is a pointer model.

    Source: VIMA (Jiang et al. 2023), ablation "gpt-decoder".
    """
    if name not in CONDITIONINGS:
        raise ConfigError(unknown_name("conditioning", name, CONDITIONINGS))
    is_prefix = isinstance(config.decoder, PrefixDecoderConfig)
    if is_prefix == (name == "prefix"):
        return config
    if isinstance(config, PointerConfig):
        raise ConfigError(
            "conditioning is 'prefix', but pointer models have cross-attention alone; take nano-bins or "
            "another preset."
        )
    old = config.decoder
    rest = {"dropout": old.dropout, "initial_std": old.initial_std}
    if is_prefix:
        layers = max(1, old.num_layers // 2)
        new = DecoderConfig(old.width, layers, old.num_heads, old.num_heads, **rest)
    else:
        new = PrefixDecoderConfig(old.width, 2 * old.num_layers, old.num_heads, **rest)
    return replace(config, decoder=new)


# In the order in which they are made: later ones see the parts of earlier ones.
SWITCHES: Mapping[str, Callable[[PolicyConfig, Any], PolicyConfig]] = {
    "conditioning": with_conditioning,
    "head": with_head,
    "visual_residual": with_visual_residual,
}
