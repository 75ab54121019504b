"""MLPs and weight initialisation."""

from collections.abc import Sequence

import torch
from torch import nn


def mlp(widths: Sequence[int]) -> nn.Sequential:
    """Build linear layers of the given widths with ReLU between them.

    Args:
        widths: Width of the input, of each hidden layer and of the output.

    Returns:
        The MLP, with orthogonal weights of gain √2 and zero biases.
    """
    layers: list[nn.Module] = []
    for i in range(len(widths) - 1):
        linear = nn.Linear(widths[i], widths[i + 1])
        nn.init.orthogonal_(linear.weight, gain=2**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU()]
    return nn.Sequential(*layers[:-1])


def normal_weights(module: nn.Module, std: float) -> None:
    """Reinitialise linear and embedding weights with a normal distribution, biases with 0."""
    for part in module.modules():
        if isinstance(part, nn.Linear | nn.Embedding):
            nn.init.normal_(part.weight, std=std)
        if isinstance(part, nn.Linear) and part.bias is not None:
            nn.init.zeros_(part.bias)


def scale_last(stack: nn.Sequential, gain: float) -> nn.Sequential:
    """Reinitialise the last layer orthogonally with another gain, so that heads start near zero."""
    with torch.no_grad():
        nn.init.orthogonal_(layer_of(stack, -1).weight, gain=gain)
    return stack


def layer_of(stack: nn.Module, index: int) -> nn.Linear:
    """Return a linear layer of an MLP: 0 is the first one, -1 the last."""
    assert isinstance(stack, nn.Sequential)
    layer = stack[index]
    assert isinstance(layer, nn.Linear)
    return layer
