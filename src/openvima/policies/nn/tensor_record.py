"""Records of tensors that move between devices, or lose or gain rows of the batch, together."""

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from itertools import accumulate
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

    def filled(self) -> Self:
        """Return the record with zeros where None stands for them, if their shape follows from the rest."""
        return self


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


def join_rows(parts: Sequence[Any], counts: Sequence[int]) -> Any:  # Any: their own kind
    """Join batches along the first axis of all tensors; their other axes are padded with zeros at the end.

    Args:
        parts: Records, tuples or tensors of one kind; None stands for rows of zeros.
        counts: Number of rows of each part.

    Returns:
        One of the same kind with all rows; None if all parts are.
    """
    given = [part for part in parts if part is not None]
    if not given:
        return None
    first = given[0]
    if isinstance(first, tuple):
        columns = [[None] * len(first) if part is None else part for part in parts]
        return tuple(join_rows(column, counts) for column in zip(*columns, strict=True))
    if not isinstance(first, torch.Tensor):
        names = [field.name for field in fields(first)]
        columns = {name: [getattr(part, name, None) for part in parts] for name in names}
        if any(0 < sum(part is None for part in column) < len(parts) for column in columns.values()):
            filled = [None if part is None else part.filled() for part in parts]
            columns = {name: [getattr(part, name, None) for part in filled] for name in names}
        return replace(first, **{name: join_rows(column, counts) for name, column in columns.items()})
    sizes = [tuple(part.shape[1:]) for part in given]
    if len(given) == len(parts) and len(set(sizes)) == 1:
        return torch.cat(given)
    joined = first.new_zeros(sum(counts), *map(max, zip(*sizes, strict=True)))
    for part, end, count in zip(parts, accumulate(counts), counts, strict=True):
        if part is not None:
            joined[(slice(end - count, end), *map(slice, part.shape[1:]))] = part
    return joined
