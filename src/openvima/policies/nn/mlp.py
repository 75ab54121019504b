"""Stacks of linear layers with ReLU between them, and how layers start."""

from collections.abc import Sequence

import torch
from torch import nn


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Build linear layers of the given widths, ReLU between them and nothing after the last.

    Args:
        widths: Width of the input, of each hidden layer and of the output.

    Returns:
        The stack; weights orthogonal with gain √2, biases 0.
    """
    layers: list[nn.Module] = []
    for i in range(len(widths) - 1):
        linear = nn.Linear(widths[i], widths[i + 1])
        nn.init.orthogonal_(linear.weight, gain=2**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def normal_weights(module: nn.Module, std: float) -> None:
    """Draw all matrices and tables of a module anew, normal with this standard deviation; biases become 0."""
    for part in module.modules():
        if isinstance(part, nn.Linear | nn.Embedding):
            nn.init.normal_(part.weight, std=std)
        if isinstance(part, nn.Linear) and part.bias is not None:
            nn.init.zeros_(part.bias)


def scale_last(stack: nn.Sequential, gain: float) -> nn.Sequential:
    """Make the last layer of a stack orthogonal with another gain; heads start near zero that way."""
    last = stack[-1]
    assert isinstance(last, nn.Linear)
    with torch.no_grad():
        nn.init.orthogonal_(last.weight, gain=gain)
    return stack
