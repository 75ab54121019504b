"""Seeds of episodes in a record of appearance statistics."""

from collections.abc import Mapping
from typing import Any


def seeds_of(entry: Mapping[str, Any]) -> list[int]:  # Any: JSON
    """All seeds of a task in the record."""
    return [seed for first, last in entry["seeds"] for seed in range(first, last + 1)]
