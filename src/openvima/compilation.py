"""Compilation of kernels by Numba, cached where a folder can be written."""

import contextlib
from collections.abc import Callable
from typing import Any

import numba


def njit(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function when it is first called, and keep the result for later processes.

    It is kept in NUMBA_CACHE_DIR, else beside the code, else in the user's cache folder. Where none of them
    can be written, each process compiles anew.
    """
    compiled = numba.njit(kernel)
    if not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]  # made from the environment
        with contextlib.suppress(RuntimeError):  # no folder can be written
            compiled.enable_caching()
    return compiled
