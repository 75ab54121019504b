"""Imports on first use, optional packages, too little memory for them, and versions."""

import contextlib
import re
import sys
from collections.abc import Callable, Mapping
from functools import lru_cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from types import MappingProxyType, ModuleType

from openvima.errors import MissingExtraError, echo


def lazy_names(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return the `__getattr__` and `__dir__` of a package.

    Listing the names, as tab completion does, imports nothing.

    Args:
        package: Name of the package; its `__all__` holds the public names.
        modules: For each lazy name the module below `package` that defines it.
    """

    def load(name: str) -> object:
        if name in modules:
            return getattr(import_module(f"{package}.{modules[name]}"), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return load, lambda: sorted(sys.modules[package].__all__)


# How torch, MuJoCo, Arrow, threads and the loader of shared libraries say that there is no memory. Libraries
# from a volume that forbids execution cannot be mapped either, for another reason.
_MESSAGES = re.compile(
    r"(can.?t|cannot|could not) allocate|out of memory|start new thread|bad_alloc"
    r"|failed to map segment from shared object(?!: [^C])",
    re.IGNORECASE,
)


def lacks_memory(error: BaseException) -> bool:
    """Whether an exception, or one that it came from, says that there is too little memory."""
    known: BaseException | None = error
    while known is not None:
        if isinstance(known, MemoryError) or _MESSAGES.search(str(known)):
            return True
        known = known.__cause__ or (None if known.__suppress_context__ else known.__context__)
    return False


def import_extra(module: str, message: str) -> ModuleType:
    """Import an optional package.

    Args:
        module: The module.
        message: What needs it and how to install it, for the error.

    Raises:
        MissingExtraError: It is not installed, or it is broken.
        MemoryError: It does not fit into memory.
    """
    try:
        return import_module(module)
    except (ImportError, OSError) as error:
        if lacks_memory(error):
            raise MemoryError(f"{module} cannot be loaded") from error
        if isinstance(error, ModuleNotFoundError) and f"{module}.".startswith(f"{error.name}."):
            raise MissingExtraError(message) from error
        raise MissingExtraError(f"{module} cannot be imported ({echo(str(error))}); {message}") from error


@lru_cache
def versions_of(*packages: str) -> Mapping[str, str]:
    """Return the versions of this package and of others that are installed, looked up once."""
    from openvima import __version__  # the package imports this module first

    found = {"openvima": __version__}
    for name in packages:
        with contextlib.suppress(PackageNotFoundError):
            found[name] = version(name)
    return MappingProxyType(found)
