"""Options that hold several values."""

import os
import re

from openvima.errors import ConfigError
from openvima.paths import expand_home
from openvima.user_code import is_code


def parse_list(text: str) -> tuple[str, ...]:
    """Split an option such as "rotate,twist"."""
    return tuple(word.strip() for word in text.split(",") if word.strip())


def parse_sources(text: str) -> tuple[str, ...]:
    """Split policies, such as "oracle,mine=runs/first"; an existing path is one of them, with its commas."""
    words, found = text.split(","), []
    while words:
        counts = range(len(words), 0, -1)
        count = next((n for n in counts if _is_path(",".join(words[:n]).strip())), 1)
        found.append(",".join(words[:count]).strip())
        del words[:count]
    return tuple(filter(None, found))


def _is_path(word: str) -> bool:
    """Whether a policy, perhaps with a name before it, is an existing path, or code in one."""
    given = expand_home(word)
    named = re.fullmatch(r"\w[\w.+-]*=(.*)", given)
    texts = (given, *(named.groups() if named else ()))
    return any(os.path.exists(text.rpartition(":")[0] if is_code(text) else text) for text in texts)


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
