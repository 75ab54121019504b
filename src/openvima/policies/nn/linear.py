"""A linear layer that is fast on CPUs: for few rows in inference, and in training.

Training uses oneDNN, which takes half the time of torch's default library on AMD CPUs (results/
2026-11-28_training_step.md); both compute in float32. Its kernels are compiled for each number of rows, so
`rounded_rows` keeps these few.
"""

import os
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

# Measured in float32 on one core with AVX-512 at width 768: weights prepacked for oneDNN take 0.65× the time
# of the default kernel for 6 rows, 0.7× for 17, 0.8× for 34 and 0.9× for 90, since that kernel repacks the
# matrix at every call. More rows gain little, and a single row is fast anyway.
_MAX_ROWS = 128
_MIN_WEIGHTS = 500_000  # smaller matrices stay in the cache of a core
_PACKED_FOR_ROWS = 16

_MIN_TRAINING_ROWS = 256  # of fewer rows there are too many numbers to compile for
# Kernels that oneDNN keeps; its default of 1,024 are fewer than training uses again. Read at its first use.
os.environ.setdefault("ONEDNN_PRIMITIVE_CACHE_CAPACITY", "16384")

# Private operations that torch.compile uses; there is no public API for them.
_HAS_ONEDNN = torch.backends.mkldnn.is_available() and hasattr(torch.ops.mkldnn, "_linear_pointwise")


class TrainingLinear(nn.Linear):
    """`nn.Linear` that computes outputs and gradients of many rows with oneDNN, on a CPU."""

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Map (..., in) to (..., out)."""
        if (
            torch.is_grad_enabled()
            and input.numel() >= _MIN_TRAINING_ROWS * self.in_features
            and self._can_use_onednn(input)
            and not torch.is_autocast_enabled("cpu")
        ):
            return _OneDnnLinear.apply(input, self.weight, self.bias)  # type: ignore[no-any-return]
        return F.linear(input, self.weight, self.bias)

    def _can_use_onednn(self, x: torch.Tensor) -> bool:
        return (
            _HAS_ONEDNN
            and not torch.compiler.is_compiling()  # it chooses by itself
            and x.dtype == self.weight.dtype == torch.float32
            and x.device.type == "cpu"
        )


class Linear(TrainingLinear):
    """With prepacked weights for the few rows of a step in inference, as well.

    They are packed at the first such call in inference mode, repacked when they change, and dropped for
    training. Results are equal up to rounding.
    """

    _packed: torch.Tensor | None = None
    _packed_version: tuple[int, int] | None = None  # address and version of the weights that were packed

    def __init__(self, in_features: int, out_features: int, bias: bool = True) -> None:
        super().__init__(in_features, out_features, bias)
        self._is_large = in_features * out_features >= _MIN_WEIGHTS

    def forward(self, input: torch.Tensor) -> torch.Tensor:
        """Map (..., in) to (..., out)."""
        if not (self._is_large and self._has_few_rows(input)):
            return super().forward(input)
        version = (self.weight.data_ptr(), self.weight._version)
        if version != self._packed_version:
            self._packed = torch.ops.mkldnn._reorder_linear_weight(self.weight.detach(), _PACKED_FOR_ROWS)
            self._packed_version = version
        return torch.ops.mkldnn._linear_pointwise(input, self._packed, self.bias, "none", [], "")

    def train(self, mode: bool = True) -> "Linear":
        """Set the mode, and drop the packed copy for training."""
        if mode:
            self._packed = self._packed_version = None
        return super().train(mode)

    def __getstate__(self) -> dict[str, Any]:  # Any: attributes of all kinds
        """Exclude the packed copy from copies and pickles."""
        return {**self.__dict__, "_packed": None, "_packed_version": None}

    def _has_few_rows(self, x: torch.Tensor) -> bool:
        return (
            torch.is_inference_mode_enabled()
            and self.in_features < x.numel() <= _MAX_ROWS * self.in_features
            and self._can_use_onednn(x)
            and not self.weight.is_inference()  # such tensors have no version
        )


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


def rounded_rows(count: int) -> int:
    """Round a number of rows up to one of 16 in each octave, if it is large."""
    if count < _MIN_TRAINING_ROWS:
        return count
    step = 1 << (count.bit_length() - 5)
    return -(-count // step) * step
