"""Checks of the plain values that users and their files give for a scene."""

import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any  # of whatever type a user gives

from openvima.errors import SceneError, echo, unknown_name
from openvima.scene import Placement

MAX_ENTRIES = 256
_NO_TEXT = ("Cc", "Cs")  # categories of Unicode: control characters, halves of surrogate pairs


def shown(value: object) -> str:
    """Return a value for an error, in 80 characters at most."""
    if isinstance(value, int) and abs(value) >= 10**20:  # digits of a huge number take long
        return "a huge number"
    if isinstance(value, str | bytes):
        return echo(repr(value[:80]), 80)
    if value is None or isinstance(value, int | float):
        return repr(value)
    if isinstance(value, list | tuple) and len(value) <= 4:
        return echo("[" + ", ".join(shown(entry) for entry in value) + "]", 80)
    return f"a {type(value).__name__}"


def odd_character(text: str, allowed: str = "") -> str:
    """Name the first character that is not for text, such as "U+0007"; empty if there is none.

    Joiners, marks of direction and characters that this version of Python does not know are for text.
    """
    odd = (c for c in text if unicodedata.category(c) in _NO_TEXT and c not in allowed)
    return next((f"U+{ord(c):04X}" for c in odd), "")


def entries(value: object, label: str) -> Sequence[Any]:
    """Return a list or tuple of limited length.

    Raises:
        SceneError: It is none.
    """
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise SceneError(f"{label} is {shown(value)}; give a list.")
    if len(value) > MAX_ENTRIES:
        raise SceneError(f"{label} has {len(value)} entries; at most {MAX_ENTRIES} are allowed.")
    return value


def number(value: Any, label: str, low: float, high: float) -> float:
    """Return a finite number within limits.

    Raises:
        SceneError: It is none, or outside.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not low <= value <= high:  # NaN lies nowhere
        raise SceneError(f"{label} is {shown(value)}; give a number from {low:g} to {high:g}.")
    return float(value)


def pair(value: Any, label: str) -> tuple[float, float]:
    """Return x and y in metres.

    Raises:
        SceneError: These are not two finite numbers.
    """
    if hasattr(value, "tolist"):  # a NumPy array
        value = value.tolist()
    if not isinstance(value, Sequence) or isinstance(value, str | bytes) or len(value) != 2:
        raise SceneError(f"{label} is {shown(value)}; give x and y in metres, as in [0.45, -0.25].")
    for coordinate in value:
        is_number = isinstance(coordinate, int | float) and not isinstance(coordinate, bool)
        if not is_number or not -1e6 < coordinate < 1e6:
            raise SceneError(f"{label} is {shown(value)}; give two finite numbers, x and y in metres.")
    return float(value[0]), float(value[1])


def known_object(handle: object, handles: Mapping[str, Placement], label: str) -> Placement:
    """Return the object of a handle or an index.

    Raises:
        SceneError: The scene has no such object.
    """
    if type(handle) is int and 0 <= handle < len(handles):
        return list(handles.values())[handle]
    if isinstance(handle, str) and handle in handles:
        return handles[handle]
    name = handle if isinstance(handle, str) else shown(handle)
    raise SceneError(f"{label}: {unknown_name('object', name, handles, handles_hint(handles))}")


def handles_hint(handles: Mapping[str, Placement]) -> str:
    """Return a sentence with all handles."""
    return f"The scene has {echo(', '.join(handles))}."
