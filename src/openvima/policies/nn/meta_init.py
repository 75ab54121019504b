"""Construct networks on the meta device, to load weights into or to count parameters."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import nn
from torch.overrides import TorchFunctionMode

# Initialisers and the arithmetic on their results. On meta tensors their first call would import torch's
# compiler, which takes one to four seconds.
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
    """A context that creates tensors on the meta device, except those with an explicit device."""

    def __torch_function__(
        self,
        func: Callable[..., Any],  # Any: whatever torch's functions take and give
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        """Skip initialisers, and create new tensors on the meta device."""
        kwargs = kwargs or {}
        if func in _SKIPPED:
            return args[0] if args else kwargs["tensor"]
        with torch.device("meta"):
            return (torch.empty if func is torch.randn else func)(*args, **kwargs)
