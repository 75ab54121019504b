"""Configs from the values in a file."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from reprlib import repr as short
from types import NoneType, UnionType
from typing import Any, get_args, get_type_hints

from openvima.errors import ConfigError
from openvima.policies.limits import check_field


def build_config(kind: type, values: Any, where: str) -> Any:  # Any: the dataclass, and what a file holds
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
        check_field(hints[name], value, f"{where}.{name}")
    arguments = {name: _value(hints[name], value, f"{where}.{name}") for name, value in values.items()}
    try:
        return kind(**arguments)
    except (TypeError, ArithmeticError) as error:
        raise ConfigError(f"{where}: {error}.") from error


def _value(hint: Any, value: Any, where: str) -> Any:  # Any: a type as written in the dataclass
    if isinstance(hint, UnionType):
        if value is None and NoneType in get_args(hint):
            return None
        options = [option for option in get_args(hint) if option is not NoneType]
        hint = max(options, key=lambda option: _num_shared_fields(option, value))
    if is_dataclass(hint) and isinstance(hint, type):
        return build_config(hint, value, where)
    return tuple(value) if isinstance(value, list) else value


def _num_shared_fields(kind: Any, value: Any) -> int:  # Any: a type as written in the dataclass
    """Score how well a mapping matches the fields of a dataclass, to resolve unions."""
    if not is_dataclass(kind) or not isinstance(value, Mapping):
        return 0
    names = {field.name for field in fields(kind)}
    return len(names & set(value)) - len(names ^ set(value))
