"""Importing packages that are not always installed."""

from importlib import import_module
from types import ModuleType

from openvima.errors import MissingExtraError, echo
from openvima.memory import lacks_memory


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
