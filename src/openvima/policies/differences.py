"""How error messages tell what differs between weights and a network."""

from collections.abc import Sequence

import torch


def listed(what: str, names: Sequence[str], *, most: int) -> list[str]:
    """Compose "what: first, second and 3 more", as a list of one; without names an empty list."""
    if not names:
        return []
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return [f"{what}: {', '.join(names[:most])}{more}"]


def described(dtype: torch.dtype, shape: Sequence[int] | None = None) -> str:
    """Tell a precision, and a shape if there is one, such as "float32 (768, 4)"."""
    name = str(dtype).removeprefix("torch.")
    return name if shape is None else f"{name} {tuple(shape)}"
