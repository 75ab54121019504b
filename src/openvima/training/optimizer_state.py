"""What an optimizer remembers, by the names of parameters, as checkpoints hold it."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn


def named_state(
    module: nn.Module, optimizer: torch.optim.Optimizer
) -> dict[str, Any]:  # Any: as torch has it
    """Return what an optimizer remembers of each parameter of a module, by its name."""
    names = {id(parameter): name for name, parameter in module.named_parameters()}
    return {names[id(parameter)]: values for parameter, values in optimizer.state.items()}


def load_named_state(
    module: nn.Module, optimizer: torch.optim.Optimizer, state: Mapping[str, Any]
) -> None:  # Any: as above
    """Undo `named_state`; the optimizer may have its parameters in another order."""
    names = {id(parameter): name for name, parameter in module.named_parameters()}
    ordered = [names[id(p)] for group in optimizer.param_groups for p in group["params"]]
    values = {number: dict(state[name]) for number, name in enumerate(ordered) if name in state}
    optimizer.load_state_dict({**optimizer.state_dict(), "state": values})
