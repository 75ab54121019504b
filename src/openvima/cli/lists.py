"""Options that hold several values."""

import re

from openvima.errors import ConfigError


def parse_list(text: str) -> tuple[str, ...]:
    """Split an option such as "rotate,twist"."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def parse_tasks(text: str) -> tuple[str, ...] | None:
    """Split the names of tasks; None for "all"."""
    names = parse_list(text)
    return None if names == ("all",) else names


def parse_shard_range(text: str | None) -> tuple[int, int] | None:
    """Split a range such as "0:10".

    Raises:
        ConfigError: It is none, or empty.
    """
    found = None if text is None else re.fullmatch(r"(\d+):(\d+)", text)
    if text is not None and (found is None or int(found[1]) >= int(found[2])):
        raise ConfigError(f"shard_range is {text!r}; it must be a:b with 0 ≤ a < b, such as 0:10.")
    return None if found is None else (int(found[1]), int(found[2]))
