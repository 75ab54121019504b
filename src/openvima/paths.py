"""Paths as users give them, and the folder of the cache."""

import os
import re
import tempfile
from collections.abc import Iterable
from pathlib import Path

from openvima.errors import ConfigError

Given = str | os.PathLike[str]

_OPTION = re.compile(r"(?:--)?(?:[\w.-]+=)+(?=~)")  # of --out=~/demos and of mine=~/runs/mine


def as_path(given: Given) -> Path:
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
    """Return a word with the user's home for `~`, also after the name of an option or policy and `=`."""
    option = _OPTION.match(word)
    start = option.end() if option else 0
    return word[:start] + str(as_path(word[start:])) if word.startswith("~", start) else word


def as_text(given: Given) -> str:
    """Return a name or path as text, with the user's home for `~`; what a `Path` gives is no name."""
    if isinstance(given, str):
        return str(as_path(given)) if given.startswith("~") else given
    path = as_path(given)
    return str(path) if len(path.parts) > 1 else os.path.join(os.curdir, path)


def names_of(given: Given | Iterable[Given]) -> tuple[str, ...]:
    """Return names as a tuple of text; a single one counts as a list of it."""
    return tuple(as_text(name) for name in ((given,) if isinstance(given, str | os.PathLike) else given))


def settle(
    config: object, *, paths: Iterable[str] = (), texts: Iterable[str] = (), names: Iterable[str] = ()
) -> None:
    """Let fields of a frozen config take what users write for them.

    Args:
        config: The config; fields that are None, or of a type that its own checks refuse, stay.
        paths: Fields with a path, which may be text and may begin with `~`.
        texts: Fields with a name or a path as text.
        names: Fields with a tuple of names or paths as text, or with a single one.
    """
    for name in paths:
        if isinstance(given := getattr(config, name), str | os.PathLike):
            object.__setattr__(config, name, as_path(given))
    for name in texts:
        if isinstance(given := getattr(config, name), str | os.PathLike):
            object.__setattr__(config, name, as_text(given))
    for name in names:
        if isinstance(given := getattr(config, name), str | os.PathLike | list | tuple):
            object.__setattr__(config, name, names_of(given))


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
