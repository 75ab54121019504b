"""Text representations that fit a screen: arrays by shape, long sequences by their beginning."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

MAX_CHARACTERS = 800  # of a representation
_MAX_TEXT = 100  # characters of one value
_MAX_ITEMS = 3  # of a sequence or mapping
_MAX_DEPTH = 3


def brief_repr(self: object) -> str:
    """Represent a dataclass briefly; for `__repr__ = brief_repr` in its body.

    Example:
        >>> Step({"rgb": {"top": np.zeros((3, 128, 256), np.uint8)}}, action)
        Step(observation={'rgb': {'top': <uint8 (3, 128, 256)>}}, action=Action(…))
    """
    return cut(_shown(self, _MAX_DEPTH), MAX_CHARACTERS)


def cut(text: str, length: int) -> str:
    """Cut a text to a length, with an ellipsis."""
    return text if len(text) <= length else f"{text[: length - 1]}…"


def _shown(value: Any, depth: int) -> str:  # Any: any field
    name = type(value).__name__
    if hasattr(value, "dtype") and hasattr(value, "shape"):  # an array or a tensor
        return f"<{value.dtype} {tuple(value.shape)}>"
    if isinstance(value, Mapping):
        pairs = (f"{key!r}: {_shown(item, depth - 1)}" for key, item in value.items())
        return f"{{{_joined(pairs, value, depth)}}}"
    if isinstance(value, tuple | list | set | frozenset):
        left, right = "[]" if isinstance(value, list) else "()" if isinstance(value, tuple) else "{}"
        comma = "," if isinstance(value, tuple) and len(value) == 1 else ""
        return f"{left}{_joined((_shown(item, depth - 1) for item in value), value, depth)}{comma}{right}"
    if is_dataclass(value) and not isinstance(value, type):
        parts = (
            f"{field.name}={_shown(getattr(value, field.name), depth - 1)}"
            for field in fields(value)
            if field.repr
        )
        return f"{name}({', '.join(parts) if depth else '…'})"
    return cut(repr(value), _MAX_TEXT)


def _joined(parts: Iterable[str], whole: Collection[object], depth: int) -> str:
    """Join the first items; those of single values, such as a vector, all."""
    limit = _MAX_ITEMS if depth > 0 else 0
    if len(whole) <= 8 and all(isinstance(item, float | int) for item in whole):
        limit = len(whole)
    shown = [part for _, part in zip(range(limit), parts, strict=False)]
    rest = len(whole) - len(shown)
    return ", ".join([*shown, *([f"… {rest} more" if shown else "…"] if rest else [])])
