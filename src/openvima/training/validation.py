"""Checks of settings, which may come from a file and so be anything."""

from collections.abc import Iterator, Mapping
from numbers import Integral, Real
from typing import Any, get_args, get_type_hints

from openvima.errors import unknown_name

Bounds = Mapping[str, tuple[float, float | None]]

# What values of a type may be, and how that is called.
_TYPES = {
    int: (Integral, "a whole number"),
    float: (Real, "a number"),
    bool: (bool, "true or false"),
    str: (str, "text"),
}


def problems_of(settings: object, bounds: Bounds) -> Iterator[str]:
    """Say of each setting that cannot be as it is why.

    Args:
        settings: A dataclass; the types of its fields decide what they may hold.
        bounds: Smallest and largest allowed value of numbers by name; None means no bound on that side.
    """
    for name, hint in get_type_hints(type(settings)).items():
        if problem := _problem(name, getattr(settings, name), get_args(hint) or (hint,), bounds):
            yield problem


def _problem(name: str, value: Any, kinds: tuple[Any, ...], bounds: Bounds) -> str | None:
    # Any: the value may be anything; the kinds are words from which to choose, or types.
    if isinstance(kinds[0], str):
        return None if value in kinds else unknown_name(name, value, kinds)
    if kinds[0] not in _TYPES or (value is None and type(None) in kinds):
        return None
    kind, called = _TYPES[kinds[0]]
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        return f"{name} is {value!r}; it must be {called}."
    return _out_of_range(name, value, *bounds[name]) if name in bounds else None


def _out_of_range(name: str, value: Any, low: float, high: float | None) -> str | None:  # Any: a number
    if low <= value and (high is None or value <= high):
        return None
    allowed = f"at least {low:g}" if high is None else f"between {low:g} and {high:g}"
    return f"{name} is {value:g}; it must be {allowed}."
