"""Compilation of kernels by Numba, cached where a folder can be written."""

import contextlib
import os
from collections.abc import Callable
from typing import Any

import numba
from numba.core import config as numba_config


def njit(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function when it is first called, and keep the result for later processes.

    It is kept in NUMBA_CACHE_DIR, else beside the code, else in the user's cache folder. Where none of them
    can be written, and for users without a home, each process compiles anew.
    """
    compiled = numba.njit(kernel)
    config: Any = numba_config  # a module that makes its names from the environment
    has_home = os.path.expanduser("~") != "~"  # else Numba would make a folder of that name
    if not config.DISABLE_JIT and (config.CACHE_DIR or has_home):
        with contextlib.suppress(RuntimeError):  # no folder can be written
            compiled.enable_caching()
    return compiled
