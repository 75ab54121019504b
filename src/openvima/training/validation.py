"""Settings by dotted name, and the ranges of their values."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeGuard, TypeVar, get_args, get_origin, get_type_hints

from openvima.errors import ConfigError, unknown_name
from openvima.input_files import as_path
from openvima.policies.config_fields import Range, options_of

Count = Annotated[int, Range(1)]
Steps = Annotated[int, Range(0)]
Probability = Annotated[float, Range(0, 1)]

Settings = TypeVar("Settings")


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
        types |= setting_types(hint, f"{prefix}{name}.") if _is_section(hint) else {prefix + name: hint}
    return types


def path_settings(kind: type) -> list[str]:
    """Return the settings of a dataclass itself that are paths."""
    return [name for name, hint in get_type_hints(kind).items() if Path in options_of(hint)]


def from_settings(kind: type[Settings], settings: Mapping[str, Any]) -> Settings:
    """Make a dataclass of dataclasses from settings by dotted name; those left out keep their defaults.

    Raises:
        ConfigError: A name is no setting.
    """
    known = setting_types(kind)
    if problems := [unknown_name("setting", name, known) for name in settings if name not in known]:
        raise ConfigError(" ".join(problems))
    return _build_nested(kind, settings, "")


def _build_nested(kind: type[Settings], settings: Mapping[str, Any], prefix: str) -> Settings:
    values = {}
    defaults = {field.name: field.default for field in fields(kind)}  # type: ignore[arg-type]  # a dataclass
    for name, hint in get_type_hints(kind).items():
        if _is_section(hint):
            default = {f"{prefix}{name}.{key}": v for key, v in _values(defaults[name]).items()}
            values[name] = _build_nested(hint, {**default, **settings}, f"{prefix}{name}.")
        elif prefix + name in settings:
            values[name] = settings[prefix + name]
    return kind(**values)


def _is_section(hint: Any) -> TypeGuard[type]:
    return is_dataclass(hint)


def _values(section: Any) -> dict[str, Any]:
    return {field.name: getattr(section, field.name) for field in fields(section)}


def convert(value: Any, hint: Any) -> Any:
    """Convert text to paths and numbers; YAML reads 1e-4, without a point, as text."""
    kinds = {get_args(each)[0] if get_origin(each) is Annotated else each for each in options_of(hint)}
    if not isinstance(value, str) or not {Path, float} & kinds:
        return value
    try:
        return as_path(value) if Path in kinds else float(value)
    except ValueError:  # reported by `problems_of`
        return value
