"""A device of torch that computes on the CPU, but refuses tensors of two devices in one operation, like GPUs.

It is registered for the whole process, so it is imported in one of its own only.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch.utils._pytree import tree_leaves, tree_map
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

NAME = "python"
_setup_privateuseone_for_python_backend(NAME)
_TAKE_TWO = ("copy_", "_copy_from", "_to_copy", "index", "_index_put")  # operations that a GPU does with both


class DeviceTensor(torch.Tensor):
    """A tensor of the device; `inner` is on the CPU."""

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> "DeviceTensor":
        made = torch.Tensor._make_wrapper_subclass(
            cls,
            inner.size(),
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            layout=inner.layout,
            device=torch.device(NAME, 0),
        )
        made.inner = inner
        return made

    def tolist(self) -> list:
        return self.inner.tolist()

    @classmethod
    def __torch_dispatch__(cls, operation, types, args=(), kwargs=None):
        return _compute(operation, args, kwargs or {})


def _inner(value: Any) -> Any:
    return value.inner if isinstance(value, DeviceTensor) else value


def _compute(operation: Callable, args: tuple, kwargs: dict) -> Any:
    name = str(operation).removeprefix("aten.")
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    ours = {id(tensor.inner): tensor for tensor in tensors if isinstance(tensor, DeviceTensor)}
    others = [tensor for tensor in tensors if not isinstance(tensor, DeviceTensor) and tensor.ndim]
    if ours and others and not name.startswith(_TAKE_TWO):
        raise RuntimeError(f"{name} got tensors of two devices; those of the CPU are {others}")
    if kwargs.get("generator") is not None:
        raise RuntimeError(f"{name} got a generator of the CPU")
    target = kwargs.get("device")
    on_cpu = {**kwargs, "device": torch.device("cpu")} if target is not None else kwargs
    result = operation(*tree_map(_inner, args), **tree_map(_inner, on_cpu))
    if target is not None and torch.device(target).type == "cpu":
        return result

    def wrapped(value: Any) -> Any:
        if not isinstance(value, torch.Tensor):
            return value
        return ours[id(value)] if id(value) in ours else DeviceTensor(value)

    return tree_map(wrapped, result)


def _copy(source: torch.Tensor, target: torch.Tensor, non_blocking: bool = False) -> torch.Tensor:
    _inner(target).copy_(_inner(source))
    return target


def _arange(*args: float, dtype=None, layout=None, device=None, pin_memory=None) -> DeviceTensor:
    return DeviceTensor(torch.arange(*args, dtype=dtype))


_ALL, _ATEN = torch.library.Library("_", "IMPL"), torch.library.Library("aten", "IMPL")
_ALL.fallback(lambda operation, *args, **kwargs: _compute(operation, args, kwargs), "PrivateUse1")
_ATEN.impl("_copy_from", _copy, "PrivateUse1")
for _form in ("arange", "arange.start", "arange.start_step"):
    _ATEN.impl(_form, _arange, "PrivateUse1")
