"""Records of tensors that move between devices, or lose rows of the batch, together."""

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any, Self

import torch


class TensorRecord:
    """Base of dataclasses of tensors; fields may be records or tuples of tensors as well."""

    __slots__ = ()

    def to(self, device: torch.device | str) -> Self:
        """Return the record on another device."""
        return map_tensors(self, lambda tensor: tensor.to(device))

    def select(self, rows: Sequence[int] | torch.Tensor) -> Self:
        """Return some rows of the batch, the first axis of all tensors."""
        index = rows if isinstance(rows, torch.Tensor) else torch.tensor(rows, dtype=torch.int64)
        return map_tensors(self, lambda tensor: tensor[index.to(tensor.device)])


def map_tensors(value: Any, function: Callable[[torch.Tensor], torch.Tensor]) -> Any:  # Any: its own kind
    """Apply a function to all tensors of a record or tuple; values of other kinds stay."""
    if isinstance(value, torch.Tensor):
        return function(value)
    if isinstance(value, tuple):
        return tuple(map_tensors(each, function) for each in value)
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value)]
        return replace(value, **{name: map_tensors(getattr(value, name), function) for name in names})
    return value
