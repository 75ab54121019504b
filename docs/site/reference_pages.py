"""Reference pages: one for each package, with an entry for every public name."""

import importlib
import pkgutil
from collections.abc import Iterator, Mapping
from types import ModuleType

import openvima
from openvima import errors


def public_names() -> dict[str, tuple[str, ...]]:
    """Map each package with `__all__` to its names, and `openvima.errors` to its exceptions."""
    names = {module.__name__: tuple(sorted(module.__all__)) for module in _packages()}
    kinds = {name: kind for name, kind in vars(errors).items() if isinstance(kind, type)}
    names[errors.__name__] = tuple(
        sorted(name for name in kinds if kinds[name].__module__ == errors.__name__)
    )
    return dict(sorted(names.items()))


def _packages() -> Iterator[ModuleType]:
    yield openvima
    for module in pkgutil.walk_packages(openvima.__path__, "openvima."):
        if module.ispkg:
            package = importlib.import_module(module.name)
            if hasattr(package, "__all__"):
                yield package


def reference_pages(names: Mapping[str, tuple[str, ...]]) -> dict[str, str]:
    """Map paths of pages to Markdown in which mkdocstrings fills in signatures and docstrings."""
    pages = {}
    for package, members in names.items():
        summary = (importlib.import_module(package).__doc__ or "").partition("\n")[0]
        entries = "\n".join(f"::: {package}.{name}" for name in members if not name.startswith("__"))
        pages[f"reference/{package}.md"] = f"# {package}\n\n{summary}\n\n{entries}\n"
    rows = "\n".join(
        f"| [`{package}`]({package}.md) | {', '.join(f'`{name}`' for name in members)} |"
        for package, members in names.items()
    )
    index = f"# Python API\n\nEvery public name of the package.\n\n| package | names |\n|---|---|\n{rows}\n"
    return {"reference/index.md": index, **pages}
