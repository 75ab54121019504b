"""The whole content of nested dataclasses as text, for digests and comparisons."""

from dataclasses import fields, is_dataclass
from typing import Any


def full_repr(value: Any) -> str:  # Any: narrowed below
    """Return what the `__repr__` that dataclasses generate returns; those of the package are brief."""
    kind = type(value)
    if kind is tuple:
        items = [full_repr(item) for item in value]
        return f"({items[0]},)" if len(items) == 1 else f"({', '.join(items)})"
    if kind is list:
        return f"[{', '.join(map(full_repr, value))}]"
    if kind is dict:
        return f"{{{', '.join(f'{key!r}: {full_repr(item)}' for key, item in value.items())}}}"
    if is_dataclass(value) and not isinstance(value, type):
        parts = (
            f"{field.name}={full_repr(getattr(value, field.name))}" for field in fields(value) if field.repr
        )
        return f"{type(value).__qualname__}({', '.join(parts)})"
    return repr(value)
