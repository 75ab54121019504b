"""Types and limits of config fields, checked before a network is built from a file."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from reprlib import repr as short
from types import NoneType, UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from openvima.errors import ConfigError

# Largest whole numbers by name of the field; the largest published policy has 22 layers 768 wide.
_LIMITS = {"num_layers": 128, "num_blocks": 128, "depths": 128, "vocabulary_size": 1_000_000}
MAX_WIDTH = 16_384  # of all other fields
_MAX_LENGTH = 16  # of lists
_MAX_FLOAT = 1e6


def check_limits(config: object, where: str) -> None:
    """Check the fields of a config and of the configs in it.

    Args:
        config: A dataclass.
        where: Its name in messages.

    Raises:
        ConfigError: A field has the wrong type or lies beyond its limit.
    """
    for name, hint in get_type_hints(type(config)).items():
        if is_dataclass(value := getattr(config, name)):
            check_limits(value, f"{where}.{name}")
        else:
            check_field(hint, value, f"{where}.{name}")


def check_field(hint: Any, value: Any, where: str) -> None:
    """Check one value against its annotation; configs inside configs are not checked.

    Raises:
        ConfigError: It has the wrong type or lies beyond its limit.
    """
    options = get_args(hint) if isinstance(hint, UnionType) else (hint,)
    kind = options[0]
    if is_dataclass(kind) or (value is None and NoneType in options):
        return
    if get_origin(kind) is tuple:
        if not isinstance(value, list | tuple) or len(value) > _MAX_LENGTH:
            raise ConfigError(
                f"{where} is {short(value)}; it must be a list of at most {_MAX_LENGTH} numbers."
            )
        for item in value:
            check_field(get_args(kind)[0], item, where)
        return
    allowed = _allowed(kind, value, where.rpartition(".")[2])
    if allowed is not None:
        raise ConfigError(f"{where} is {short(value)}; it must be {allowed}.")


def _allowed(kind: Any, value: Any, name: str) -> str | None:
    """Return what is allowed instead of a value; None if it is allowed."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if get_origin(kind) is Literal:
        return None if value in get_args(kind) else " or ".join(map(repr, get_args(kind)))
    if kind is bool:
        return None if isinstance(value, bool) else "true or false"
    if kind is int:
        limit = _LIMITS.get(name, MAX_WIDTH)
        fits = is_number and isinstance(value, int) and 0 <= value <= limit
        return None if fits else f"a whole number between 0 and {limit}"
    if kind is float:
        fits = is_number and math.isfinite(value) and abs(value) <= _MAX_FLOAT
        return None if fits else f"a number between {-_MAX_FLOAT:g} and {_MAX_FLOAT:g}"
    return None


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
        check_field(hints[name], value, f"{where}.{name}")
    arguments = {name: _value(hints[name], value, f"{where}.{name}") for name, value in values.items()}
    try:
        return kind(**arguments)
    except (TypeError, ArithmeticError) as error:
        raise ConfigError(f"{where}: {error}.") from error


def _value(hint: Any, value: Any, where: str) -> Any:
    if isinstance(hint, UnionType):
        if value is None and NoneType in get_args(hint):
            return None
        options = [option for option in get_args(hint) if option is not NoneType]
        hint = max(options, key=lambda option: _num_shared_fields(option, value))
    if is_dataclass(hint) and isinstance(hint, type):
        return build_config(hint, value, where)
    return tuple(value) if isinstance(value, list) else value


def _num_shared_fields(kind: Any, value: Any) -> int:
    """Score how well a mapping matches the fields of a dataclass, to resolve unions."""
    if not is_dataclass(kind) or not isinstance(value, Mapping):
        return 0
    names = {field.name for field in fields(kind)}
    return len(names & set(value)) - len(names ^ set(value))
