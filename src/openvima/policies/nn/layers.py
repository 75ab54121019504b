"""Layers: linear ones that are fast on CPUs, MLPs, batches without their padding, records of tensors.

Training on CPUs with AVX-512 uses oneDNN, which takes half the time of torch's default library on those of
AMD (results/2026-11-28_training_step.md); both compute in float32. Its kernels are compiled for each number
of rows, so `round_rows` keeps these few.

Shape suffixes: B batch, L positions, N positions of all rows that are computed, D width.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from itertools import pairwise
from typing import Any, Self

import torch
from torch import nn
from torch.nn import functional as F
from torch.overrides import TorchFunctionMode

_MIN_TRAINING_ROWS = 256  # of fewer rows there are too many numbers to compile for
# Kernels that oneDNN keeps; its default of 1,024 are fewer than training uses again. Read at its first use.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "16384")

# Private operations that torch.compile uses; there is no public API for them. Without AVX-512 they are slower
# than torch's own; see results/2026-11-30_turns.md.
_TRAINS_BY_ONEDNN = (
    torch.backends.mkldnn.is_available()
    and hasattr(torch.ops.mkldnn, "_linear_pointwise")
    and torch.backends.cpu.get_cpu_capability() == "AVX512"
)


class Linear(nn.Linear):
    """`nn.Linear` that computes outputs and gradients of many rows with oneDNN, on a CPU with AVX-512."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Map (..., in) to (..., out)."""
        if (
            _TRAINS_BY_ONEDNN
            and torch.is_grad_enabled()
            and input.numel() >= _MIN_TRAINING_ROWS * self.in_features
            and input.dtype == self.weight.dtype == torch.float32
            and input.device.type == "cpu"
            and not torch.is_autocast_enabled("cpu")
        ):
            return _OneDnnLinear.apply(input, self.weight, self.bias)  # type: ignore[no-any-return]
        return F.linear(input, self.weight, self.bias)


class _OneDnnLinear(torch.autograd.Function):
    """x Wᵀ + b and its gradients; each is a product of the form that oneDNN's linear layer computes."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
        ctx.save_for_backward(x, weight)
        ctx.has_bias = bias is not None
        return _product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (gradient,), (x, weight) = gradients, ctx.saved_tensors
        rows = gradient.reshape(-1, gradient.shape[-1])
        needs_x, needs_weight, _ = ctx.needs_input_grad
        return (
            _product(gradient, weight.T) if needs_x else None,
            _product(rows.T, x.reshape(-1, x.shape[-1]).T) if needs_weight else None,
            rows.sum(0) if ctx.has_bias else None,
        )


def _product(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
    return torch.ops.mkldnn._linear_pointwise(x, weight, bias, "none", [], "")


def round_rows(count: int) -> int:
    """Round a number of rows up to one of 16 in each octave, if it is large."""
    if count < _MIN_TRAINING_ROWS:
        return count
    step = 1 << (count.bit_length() - 5)
    return -(-count // step) * step


def mlp(widths: Sequence[int], *, last_gain: float | None = None) -> nn.Sequential:
    """Build linear layers of the given widths with ReLU between them.

    Args:
        widths: Width of the input, of each hidden layer and of the output.
        last_gain: Gain of the last layer, which is drawn once more, so that heads start near zero.

    Returns:
        The MLP, with orthogonal weights of gain √2 and zero biases.
    """
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        linear = nn.Linear(inputs, outputs)
        nn.init.orthogonal_(linear.weight, gain=2**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear, nn.ReLU()]
    stack = nn.Sequential(*layers[:-1])
    if last_gain is not None:
        nn.init.orthogonal_(layer_of(stack, -1).weight, gain=last_gain)
    return stack


def normal_weights(module: nn.Module, std: float) -> None:
    """Reinitialise linear and embedding weights with a normal distribution, biases with 0."""
    for part in module.modules():
        if isinstance(part, nn.Linear | nn.Embedding):
            nn.init.normal_(part.weight, std=std)
        if isinstance(part, nn.Linear) and part.bias is not None:
            nn.init.zeros_(part.bias)


def layer_of(stack: Any, index: int) -> nn.Linear:  # lists of modules do not say that theirs are MLPs
    """Return a linear layer of an MLP: 0 is the first one, -1 the last."""
    return stack[index]


def valid_first(mask_BL: torch.Tensor, min_count: int = 0) -> torch.Tensor:
    """Positions of each row where a mask is true, in order, then some others: as many as any row has."""
    order_BL = mask_BL.to(torch.int8).argsort(dim=1, descending=True, stable=True)
    return order_BL[:, : max(min_count, int(mask_BL.sum(dim=1).max()))]


class Unpadder:
    """Packs the valid positions of a padded batch and scatters them back.

    In training the rows are rounded up by copies of the first, which are dropped again; see `round_rows`.

    Args:
        valid_BL: The positions that are computed; the others are zero, and visible to attention alone.
    """

    def __init__(self, valid_BL: torch.Tensor) -> None:
        self._shape = valid_BL.shape
        index_N = valid_BL.flatten().nonzero().squeeze(1)
        self._index_N = None if len(index_N) == valid_BL.numel() else index_N
        self._count = len(index_N)
        if self._index_N is not None and torch.is_grad_enabled():
            self._index_N = F.pad(index_N, (0, round_rows(self._count) - self._count))

    def unpad(self, x_BLD: torch.Tensor) -> torch.Tensor:
        """Return the valid rows, (N, D), or the batch unchanged if all are."""
        return x_BLD if self._index_N is None else x_BLD.flatten(0, 1).index_select(0, self._index_N)

    def pad(self, x_ND: torch.Tensor) -> torch.Tensor:
        """Undo `unpad`, with zeros at invalid positions."""
        if self._index_N is None:
            return x_ND
        zeros = x_ND.new_zeros(self._shape.numel(), x_ND.shape[-1])
        return zeros.index_copy(0, self._index_N[: self._count], x_ND[: self._count]).unflatten(
            0, self._shape
        )


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
        func: Callable[..., Any],
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


def map_tensors(value: Any, function: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    """Apply a function to all tensors of a record or tuple; values of other kinds stay."""
    if isinstance(value, torch.Tensor):
        return function(value)
    if isinstance(value, tuple):
        return tuple(map_tensors(each, function) for each in value)
    if is_dataclass(value) and not isinstance(value, type):
        names = [field.name for field in fields(value)]
        return replace(value, **{name: map_tensors(getattr(value, name), function) for name in names})
    return value
