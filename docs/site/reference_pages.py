"""Reference pages: one for each package and each module that pages import, with every public name."""

import importlib
import pkgutil
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType

import openvima
from openvima import errors

ROOT = Path(__file__).parents[2]
_IMPORT = re.compile(r"^\s*(?:from|import) (openvima(?:\.\w+)+)", re.MULTILINE)


def public_names() -> dict[str, tuple[str, ...]]:
    """Map each package with `__all__` to its names, and each module that pages import to its definitions.

    Of `openvima.errors`, which holds functions for the package too, these are the exceptions alone.
    """
    names = {module.__name__: tuple(sorted(module.__all__)) for module in _packages()}
    names[errors.__name__] = tuple(
        name for name in _definitions(errors) if isinstance(vars(errors)[name], type)
    )
    for module in sorted(_imported_by_pages() - names.keys()):
        if defined := _definitions(importlib.import_module(module)):
            names[module] = defined
    return dict(sorted(names.items()))


def _imported_by_pages() -> set[str]:
    """Names of the modules that pages, notebooks and examples import."""
    files = [
        ROOT / "README.md",
        *ROOT.glob("docs/*.md"),
        *ROOT.glob("notebooks/*.py"),
        *ROOT.glob("examples/*.py"),
    ]
    return {name for file in files for name in _IMPORT.findall(file.read_text(encoding="utf-8"))}


def _definitions(module: ModuleType) -> tuple[str, ...]:
    """Public classes and functions that a module defines itself."""
    found = (
        name for name, value in vars(module).items() if getattr(value, "__module__", "") == module.__name__
    )
    return tuple(sorted(name for name in found if not name.startswith("_") and callable(vars(module)[name])))


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
