"""Layers without initial values, for networks that get their weights from elsewhere or are only counted."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn
from torch.overrides import TorchFunctionMode

# Draws, and arithmetic on what was drawn. On tensors without values it would be quick but for the first call,
# at which torch loads its compiler: one to four seconds.
_SKIPPED = {
    nn.init.kaiming_uniform_,
    nn.init.normal_,
    nn.init.uniform_,
    torch.Tensor.__imul__,
    torch.Tensor.copy_,
    torch.Tensor.mul,
    torch.Tensor.mul_,
    torch.Tensor.normal_,
    torch.Tensor.uniform_,
}


class MetaInit(TorchFunctionMode):
    """A context in which parameters get shapes but no values; tensors on a device of their own have both."""

    def __torch_function__(
        self,
        func: Callable[..., Any],  # Any: whatever torch's functions take and give
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """Leave out what fills tensors, and make new ones without values."""
        kwargs = kwargs or {}
        if func in _SKIPPED:
            return args[0] if args else kwargs["tensor"]
        with torch.device("meta"):
            return (torch.empty if func is torch.randn else func)(*args, **kwargs)
