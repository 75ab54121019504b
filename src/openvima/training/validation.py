"""Validation of settings, which may come from a file, and settings by dotted name."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeGuard, TypeVar, Union, get_args, get_origin, get_type_hints

from openvima.errors import ConfigError, unknown_name
from openvima.input_files import as_path


@dataclass(frozen=True, slots=True)
class Range:
    """Smallest and largest allowed value of a number; None means no upper bound."""

    low: float
    high: float | None = None


Count = Annotated[int, Range(1)]
Steps = Annotated[int, Range(0)]
Probability = Annotated[float, Range(0, 1)]

Settings = TypeVar("Settings")
# Allowed type of values, and its name in messages.
_TYPES = {
    int: (Integral, "a whole number"),
    float: (Real, "a number"),
    bool: (bool, "true or false"),
    str: (str, "text"),
    Path: (Path, "a path (in YAML, quote digits)"),
}


def problems_of(settings: object, prefix: str = "") -> Iterator[str]:
    """Yield a message for each invalid setting, nested ones included.

    Args:
        settings: A dataclass whose annotations define allowed values.
        prefix: Prefix of field names.
    """
    for name, hint in get_type_hints(type(settings), include_extras=True).items():
        value = getattr(settings, name)
        if is_dataclass(value):
            yield from problems_of(value, f"{prefix}{name}.")
        elif problem := _problem(prefix + name, value, hint):
            yield problem


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
    return [name for name, hint in get_type_hints(kind).items() if Path in _options(hint)]


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
    kinds = {_plain(option)[0] for option in _options(hint)}
    if not isinstance(value, str) or not {Path, float} & kinds:
        return value
    try:
        return as_path(value) if Path in kinds else float(value)
    except ValueError:  # reported by `problems_of`
        return value


def _options(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _plain(hint: Any) -> tuple[Any, Range | None]:
    """Return a type without its annotation, and the range of its values."""
    return get_args(hint)[:2] if get_origin(hint) is Annotated else (hint, None)


def _problem(name: str, value: Any, hint: Any) -> str | None:
    options = _options(hint)
    plain, limits = _plain(options[0])
    if value is None and NoneType in options:
        return None
    if get_origin(plain) is Literal:
        return None if value in get_args(plain) else unknown_name(name, value, get_args(plain))
    if plain not in _TYPES:
        return None
    kind, called = _TYPES[plain]
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        return f"{name} is {value!r}; it must be {called}."
    return _out_of_range(name, value, limits) if limits else None


def _out_of_range(name: str, value: Any, limits: Range) -> str | None:
    low, high = limits.low, limits.high
    if low <= value and (high is None or value <= high):
        return None
    allowed = f"at least {low:g}" if high is None else f"between {low:g} and {high:g}"
    return f"{name} is {value:g}; it must be {allowed}."
