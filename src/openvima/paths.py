"""Paths as users give them, and the folder of the cache."""

import os
import re
import tempfile
from pathlib import Path

from openvima.errors import ConfigError

_OPTION = re.compile(r"(?:--)?[\w.-]+=(?=~)")  # of --out=~/demos and of mine=~/runs/mine


def as_path(given: str | os.PathLike[str]) -> Path:
    """Return a path, with `~` for the user's home.

    Raises:
        ConfigError: There is no home to put for `~`.
    """
    try:
        return Path(given).expanduser()
    except RuntimeError:
        raise ConfigError(
            f"{str(given)!r} needs a home folder, and none is known; give a full path."
        ) from None


def expand_home(word: str) -> str:
    """Return a command-line word with `~` for the user's home, also where an option or a name precedes it."""
    option = _OPTION.match(word)
    start = option.end() if option else 0
    return word[:start] + str(as_path(word[start:])) if word.startswith("~", start) else word


def cache_dir() -> Path:
    """Return the folder for derived files: $OPENVIMA_CACHE, else openvima in the user's cache folder.

    The folder may not exist yet. Everything in it can be deleted at any time. A user without a home has it
    among the temporary files.
    """
    if own := os.environ.get("OPENVIMA_CACHE"):
        return as_path(own)
    try:
        return as_path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "openvima"
    except ConfigError:
        return temporary_cache_dir()


def temporary_cache_dir() -> Path:
    """Return this user's folder for derived files among the temporary ones. It may not exist yet."""
    user = f"-{os.getuid()}" if hasattr(os, "getuid") else ""  # on Windows each user has temporary files
    try:
        return Path(tempfile.gettempdir()) / f"openvima{user}"
    except FileNotFoundError:  # none can be written: nothing is kept
        return Path(os.devnull) / "openvima"
