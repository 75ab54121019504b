"""Compilation of kernels by Numba, cached where a folder can be written."""

import contextlib
import functools
import inspect
import os
import stat
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.core import config as numba_config

from openvima.errors import ConfigError
from openvima.input_files import cache_dir, temporary_cache_dir


def njit(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function when it is first called, and keep the result for later processes.

    It is kept beside the code, else in the cache, else among the temporary files of the user. Where none of
    them can be written, each process compiles anew. NUMBA_CACHE_DIR goes before all.
    """
    compiled = numba.njit(kernel)
    config: Any = numba_config  # a module that makes its names from the environment
    if config.DISABLE_JIT:
        return compiled
    beside, own = Path(inspect.getfile(kernel)).parent / "__pycache__", config.CACHE_DIR
    folder = _first_writable(Path(own) if own else None, beside)
    if folder is not None:
        # Without a folder Numba chooses the one beside the code, or the user's, which may be one named `~`.
        config.CACHE_DIR = "" if folder == beside else str(folder)
        with contextlib.suppress(RuntimeError):  # other locations that NUMBA_CACHE_LOCATOR_CLASSES names
            compiled.enable_caching()
        config.CACHE_DIR = own
    return compiled


@functools.cache
def _first_writable(own: Path | None, beside: Path) -> Path | None:
    """Return the folder for compiled functions, if there is one."""
    return next(filter(_is_writable, [*([own] if own else []), beside, *_fallbacks()]), None)


def _fallbacks() -> Iterator[Path]:
    with contextlib.suppress(ConfigError):
        if cache_dir() != temporary_cache_dir():
            yield cache_dir() / "numba"
    # All users know its name, and what is read from it runs: none but this user may have written there.
    with contextlib.suppress(OSError):
        folder = temporary_cache_dir()
        folder.mkdir(mode=0o700, exist_ok=True)
        status = folder.lstat()
        writers = stat.S_IWGRP | stat.S_IWOTH
        if not hasattr(os, "getuid") or (
            stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & writers
        ):
            yield folder / "numba"


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True
