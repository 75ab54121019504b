"""Settings by dotted name, and the ranges of their values."""

from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from openvima.input_files import as_path
from openvima.policies.config_fields import Range, options_of

Count = Annotated[int, Range(1)]
Steps = Annotated[int, Range(0)]
Probability = Annotated[float, Range(0, 1)]


def flatten(values: Any, prefix: str = "") -> dict[str, Any]:
    """Flatten nested settings; names are joined by dots."""
    if not isinstance(values, Mapping):
        return {prefix: values}
    result: dict[str, Any] = {}
    for name, value in values.items():
        result |= flatten(value, f"{prefix}.{name}" if prefix else str(name))
    return result


def setting_types(kind: type, prefix: str = "") -> dict[str, Any]:
    """Return the type of every setting of a dataclass by its dotted name."""
    types: dict[str, Any] = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        types |= (
            setting_types(hint, f"{prefix}{name}.")
            if isinstance(hint, type) and is_dataclass(hint)
            else {prefix + name: hint}
        )
    return types


def path_settings(kind: type) -> list[str]:
    """Return the settings of a dataclass itself that are paths."""
    return [name for name, hint in get_type_hints(kind).items() if Path in options_of(hint)]


def convert(value: Any, hint: Any) -> Any:
    """Convert text to paths and numbers; YAML reads 1e-4, without a point, as text."""
    kinds = {get_args(each)[0] if get_origin(each) is Annotated else each for each in options_of(hint)}
    if not isinstance(value, str) or not {Path, float} & kinds:
        return value
    try:
        return as_path(value) if Path in kinds else float(value)
    except ValueError:  # reported by `problems_of`
        return value
