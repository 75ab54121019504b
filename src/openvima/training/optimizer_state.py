"""Optimizer state by parameter name, as checkpoints contain it."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn


def named_state(
    module: nn.Module, optimizer: torch.optim.Optimizer
) -> dict[str, Any]:  # Any: as torch has it
    """Return the state of each parameter of a module, by its name."""
    names = {id(parameter): name for name, parameter in module.named_parameters()}
    return {names[id(parameter)]: values for parameter, values in optimizer.state.items()}


def load_named_state(
    module: nn.Module, optimizer: torch.optim.Optimizer, state: Mapping[str, Any]
) -> None:  # Any: as above
    """Load what `named_state` returned; the optimizer may have its parameters in another order.

    Moments get the memory format of their parameters, as the fused optimizer requires.
    """
    names = {id(parameter): name for name, parameter in module.named_parameters()}
    ordered = [p for group in optimizer.param_groups for p in group["params"]]
    values = {
        number: {key: _like(parameter, value) for key, value in state[names[id(parameter)]].items()}
        for number, parameter in enumerate(ordered)
        if names[id(parameter)] in state
    }
    optimizer.load_state_dict({**optimizer.state_dict(), "state": values})


def _like(parameter: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
    if value.shape != parameter.shape:
        return value  # the step count
    return torch.empty_like(parameter, dtype=value.dtype, device=value.device).copy_(value)
