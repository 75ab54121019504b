"""Paths as users give them, the folder of the cache, and bounded reading of files that others wrote."""

import io
import json
import os
import re
import stat
import tempfile
import warnings
from collections.abc import Iterable
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from openvima.errors import ConfigError, InputFileError, one_line

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
    one = str | os.PathLike
    choices = (paths, one, as_path), (texts, one, as_text), (names, one | list | tuple, names_of)
    for fields, kinds, convert in choices:
        for name in fields:
            if isinstance(given := getattr(config, name), kinds):
                object.__setattr__(config, name, convert(given))


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
        return Path(tempfile.gettempdir()) / f"openvima-{os.getuid()}"


if TYPE_CHECKING:
    import PIL.Image

# What a record of any content raises where it is not of the form that is read.
MALFORMED = (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RecursionError)
MAX_TEXT_BYTES = 64 * 1024  # of a config; the longest of the package has 10 kB


def open_regular(file: Path) -> BufferedReader:
    """Open a regular file for reading. A FIFO or device is refused and never waited for.

    Raises:
        OSError: There is no such file, or it cannot be read.
        InputFileError: It is no regular file.
    """
    descriptor = os.open(file, os.O_RDONLY | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InputFileError(f"{file} is no regular file, but a folder, pipe or device; give a regular file.")
    return os.fdopen(descriptor, "rb")


def read_bytes(file: Path, *, max_bytes: int) -> bytes:
    """Read a regular file of limited size.

    Raises:
        OSError: There is no such file, or it cannot be read.
        InputFileError: It is no regular file, or longer than `max_bytes`.
    """
    with open_regular(file) as stream:
        content = stream.read(max_bytes + 1)
    if len(content) > max_bytes:
        raise InputFileError(f"{file} has more than {max_bytes:,} bytes, the most that is read.")
    return content


def read_text(file: Path, *, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Read a regular UTF-8 file of limited size.

    Raises:
        OSError: There is no such file, or it cannot be read.
        InputFileError: It is no regular file, longer than `max_bytes`, or no UTF-8.
    """
    try:
        return read_bytes(file, max_bytes=max_bytes).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputFileError(f"{file} is no UTF-8 text ({error.reason} at byte {error.start}).") from None


def read_yaml(file: Path, *, max_bytes: int = MAX_TEXT_BYTES) -> Any:
    """Read a YAML file of limited size, without code and repeated keys.

    Raises:
        OSError: There is no such file, or it cannot be read.
        InputFileError: It is no YAML, or too large.
    """
    text = read_text(file, max_bytes=max_bytes)
    try:
        return yaml.load(text, _StrictLoader)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputFileError(f"{file} is no valid YAML: {one_line(error)}.") from None


def read_json(file: Path, *, max_bytes: int = MAX_TEXT_BYTES) -> Any:
    """Read a JSON file of at most `max_bytes`; see `read_yaml`."""
    text = read_text(file, max_bytes=max_bytes)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputFileError(f"{file} is no valid JSON: {one_line(error)}.") from None


def read_png(file: Path, *, max_bytes: int, max_side: int) -> "PIL.Image.Image":
    """Decode a PNG file of limited size.

    Args:
        file: The file.
        max_bytes: Largest size of the file.
        max_side: Largest width and height, pixels; they are checked before anything is decoded.

    Returns:
        The image, in mode RGBA.

    Raises:
        InputFileError: There is no such file, it is no regular file, too large, or no PNG file.
    """
    try:
        content = read_bytes(file, max_bytes=max_bytes)
    except (OSError, ValueError) as error:
        raise InputFileError(f"{str(file)!r} cannot be read: {one_line(error)}.") from None
    return decode_png(content, repr(str(file)), max_bytes=max_bytes, max_side=max_side)


def decode_png(content: bytes, label: str, *, max_bytes: int, max_side: int) -> "PIL.Image.Image":
    """Decode the content of a PNG file of limited size.

    Args:
        content: The bytes.
        label: What errors call it.
        max_bytes: As for `read_png`.
        max_side: As for `read_png`.

    Returns:
        The image, in mode RGBA.

    Raises:
        InputFileError: It is too large, or no PNG file.
    """
    from PIL import Image

    if len(content) > max_bytes:
        raise InputFileError(f"{label} has more than {max_bytes:,} bytes, the most allowed.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of bombs, and of damaged chunks
            with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
                width, height = image.size
                if max(width, height) > max_side:
                    raise InputFileError(
                        f"{label} has {width} × {height} pixels; sides must lie within 1 … {max_side}."
                    )
                return image.convert("RGBA")
    except InputFileError:
        raise
    except Exception as error:  # Pillow raises many kinds for damaged files
        raise InputFileError(f"{label} is no readable PNG file ({type(error).__name__}).") from None


class _StrictLoader(yaml.SafeLoader):
    """Refuses a mapping with a key twice, of which only the last would count."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping."""
        found = super().construct_mapping(node, deep)
        if len(found) < len(node.value):
            raise yaml.YAMLError(f"it has a key twice: {', '.join(map(str, found))[:80]}")
        return found
