"""Error messages about mismatched weights."""

from collections.abc import Sequence

import torch

from openvima.errors import echo


def listed(what: str, names: Sequence[str], *, limit: int) -> list[str]:
    """Return ["what: first, second and 3 more"], or an empty list without names."""
    if not names:
        return []
    more = f" and {len(names) - limit} more" if len(names) > limit else ""
    return [f"{what}: {', '.join(map(echo, names[:limit]))}{more}"]


def described(dtype: torch.dtype, shape: Sequence[int] | None = None) -> str:
    """Format a dtype, and a shape if given, such as "float32 (768, 4)"."""
    name = str(dtype).removeprefix("torch.")
    return name if shape is None else f"{name} {tuple(shape)}"
