"""Names of a package that are imported on first use, and listed before."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from types import ModuleType


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

    def public_names() -> list[str]:
        module = sys.modules[package]
        present = {
            name
            for name, value in vars(module).items()
            if name.startswith("__")
            or (isinstance(value, ModuleType) and value.__name__ == f"{package}.{name}")
        }
        return sorted({*module.__all__, *present})

    return load, public_names
