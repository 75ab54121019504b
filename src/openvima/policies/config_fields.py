"""Types and limits of the fields of configs and settings, which may come from a file."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from numbers import Integral, Real
from pathlib import Path
from reprlib import repr as short
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from openvima.errors import ConfigError, unknown_name


@dataclass(frozen=True, slots=True)
class Range:
    """Smallest and largest allowed value of a number."""

    low: float
    high: float = math.inf


# Allowed type of values, and its name in messages.
_TYPES = {
    int: (Integral, "a whole number"),
    float: (Real, "a number"),
    bool: (bool, "true or false"),
    str: (str, "text"),
    Path: (Path, "a path (in YAML, quote digits)"),
}
# Largest whole numbers in networks by name of the field; the largest published policy has 22 layers 768 wide.
_LIMITS = {"num_layers": 128, "num_blocks": 128, "depths": 128, "vocabulary_size": 1_000_000}
MAX_WIDTH = 16_384  # of all other fields
_MAX_LENGTH = 16  # of lists
_MAX_FLOAT = 1e6


def problems_of(config: object, prefix: str = "", *, of_network: bool = False) -> Iterator[str]:
    """Yield a message for each invalid field, those of nested configs included.

    Args:
        config: A dataclass whose annotations define allowed values.
        prefix: Prefix of field names.
        of_network: Whether its numbers are limited as those of networks are.
    """
    for name, hint in get_type_hints(type(config), include_extras=True).items():
        value = getattr(config, name)
        if is_dataclass(value):
            yield from problems_of(value, f"{prefix}{name}.", of_network=of_network)
        elif problem := _problem(prefix + name, value, hint, of_network=of_network):
            yield problem


def check_limits(config: object, where: str) -> None:
    """Check the config of a network, before it is built.

    Args:
        config: A dataclass.
        where: Its name in messages.

    Raises:
        ConfigError: A field has the wrong type or lies beyond its limit.
    """
    for problem in problems_of(config, f"{where}.", of_network=True):
        raise ConfigError(problem)


def options_of(hint: Any) -> tuple[Any, ...]:
    """Return the types that an annotation allows."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _problem(name: str, value: Any, hint: Any, *, of_network: bool) -> str | None:
    options, limits = options_of(hint), None
    kind = options[0]
    if get_origin(kind) is Annotated:
        kind, limits = get_args(kind)[:2]
    if value is None and NoneType in options:
        return None
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        return None if value in choices else unknown_name(name, value, map(str, choices))
    if get_origin(kind) is tuple:
        if not isinstance(value, list | tuple) or len(value) > _MAX_LENGTH:
            return f"{name} is {short(value)}; it must be a list of at most {_MAX_LENGTH} numbers."
        found = (_problem(name, item, get_args(kind)[0], of_network=of_network) for item in value)
        return next(filter(None, found), None)
    if kind not in _TYPES:
        return None
    expected, called = _TYPES[kind]
    if value is None or not isinstance(value, expected) or (isinstance(value, bool) and kind is not bool):
        return f"{name} is {short(value)}; it must be {called}."
    if of_network and kind is int:
        limits = Range(0, _LIMITS.get(name.rpartition(".")[2], MAX_WIDTH))
    elif of_network and kind is float:
        limits = Range(-_MAX_FLOAT, _MAX_FLOAT)
    if limits is None or limits.low <= value <= limits.high:
        return None
    has_end = limits.high < math.inf
    allowed = f"between {limits.low} and {limits.high}" if has_end else f"at least {limits.low}"
    return f"{name} is {short(value)}; it must be {allowed}."


def build_config(kind: type, values: Any, where: str) -> Any:
    """Build a config from nested mappings of its fields.

    Args:
        kind: A dataclass; lists become tuples, and of several dataclasses a field has the one that fits best.
        values: Values of its fields.
        where: Its name in messages.

    Raises:
        ConfigError: A field is missing or unknown, has the wrong type or lies beyond its limit, or sizes are
            inconsistent.
    """
    if not isinstance(values, Mapping):
        raise ConfigError(
            f"{where} is {short(values)}; it must be a mapping of the fields of {kind.__name__}."
        )
    hints = get_type_hints(kind)
    names = [field.name for field in fields(kind)]
    unknown = [str(name) for name in values if name not in names]
    if unknown:
        raise ConfigError(f"{where} has unknown fields {', '.join(unknown)}; allowed: {', '.join(names)}.")
    for name, value in values.items():
        if problem := _problem(f"{where}.{name}", value, hints[name], of_network=True):
            raise ConfigError(problem)
    arguments = {name: _value(hints[name], value, f"{where}.{name}") for name, value in values.items()}
    try:
        return kind(**arguments)
    except (TypeError, ArithmeticError) as error:
        raise ConfigError(f"{where}: {error}.") from error


def _value(hint: Any, value: Any, where: str) -> Any:
    options = options_of(hint)
    names: dict[Any, set[str]] = {
        kind: {field.name for field in fields(kind)} for kind in options if is_dataclass(kind)
    }
    if names and not (value is None and NoneType in options):
        given = {*value} if isinstance(value, Mapping) else set()
        # Of several dataclasses the one that shares most fields.
        best = max(names, key=lambda kind: len(names[kind] & given) - len(names[kind] ^ given))
        return build_config(best, value, where)
    return tuple(value) if isinstance(value, list) else value
