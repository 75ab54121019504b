"""MIDAS: VIMA's objects, one decoder over prompt and history, and actions told component by component.

[put, the, A front, A top, into, the, B front, B top, ., end, separator, front 1, …, top 2, x0, y0, …, d1, …]
                                                                                         |   |
                                                                                         x0  y0

What goes into the text encoder for an object is added to what comes out.
"""

from dataclasses import replace

from openvima.policies.config import PolicyConfig
from openvima.policies.families.common import Size
from openvima.policies.families.vima import vima
from openvima.policies.heads.autoregressive import AutoregressiveConfig
from openvima.policies.heads.bins import BinsConfig


def midas(size: Size) -> PolicyConfig:
    """Return MIDAS in a size."""
    return replace(with_visual_residual(with_autoregression(vima(size))), trunk=size.prefix())


def with_autoregression(sizes: PolicyConfig, wanted: bool = True) -> PolicyConfig:
    """Return the same network with each component of an action as a token of its own, or with plain bins.

    A head without such tokens stays as it is if they are not wanted.
    """
    head = sizes.head
    if wanted:
        return replace(sizes, head=AutoregressiveConfig(head.hidden_width, token_std=sizes.trunk.initial_std))
    return (
        replace(sizes, head=BinsConfig(head.hidden_width))
        if isinstance(head, AutoregressiveConfig)
        else sizes
    )


def with_visual_residual(sizes: PolicyConfig, wanted: bool = True) -> PolicyConfig:
    """Return the same network with or without the visual residual in its prompt encoder."""
    return replace(sizes, prompt=replace(sizes.prompt, visual_residual=wanted))
