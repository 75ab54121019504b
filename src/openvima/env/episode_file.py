"""Episodes as YAML or JSON files: sampled and composed ones, and scenes written by hand.

A file holds either all fields of an `Episode`, as `save_episode` writes them, or the arguments of `compose`.
Only the recorded fields are read, each with its type; names of objects and textures must exist.
"""

import base64
import contextlib
import json
import re
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any  # plain values of a file

import numpy as np
import yaml

from openvima.atomic_io import atomic_write_file
from openvima.catalog import LEVELS, Assets, load_assets, object_spec, texture_spec
from openvima.env.composing import MAX_STEPS, composed, read_photo, shown
from openvima.errors import InputFileError, OpenVimaError, echo, unknown_name
from openvima.input_files import as_path, read_json, read_yaml
from openvima.perception.objects import MAX_OBJECTS
from openvima.scene import (
    FIRST_OBJECT_ID,
    AtPose,
    Constraint,
    DistractorsApart,
    Episode,
    EveryStepCounts,
    Goal,
    InOrder,
    InZone,
    NeverTouches,
    ObjectImage,
    PhotoImage,
    Placement,
    PromptFill,
    Scene,
    SceneImage,
    ZoneKeptClear,
)
from openvima.tasks.sampling import DOMAINS, checked_seed

MAX_EPISODE_BYTES = 256 * 1024  # sampled ones have 2 to 7 kB, a photo adds up to 10
FORMATS = (".yaml", ".yml", ".json")
_KINDS: dict[Any, tuple[type, ...]] = {  # classes of fields that take several; files name them as "type"
    PromptFill: (ObjectImage, SceneImage, PhotoImage),
    Goal: (AtPose, InZone),
    Constraint: (DistractorsApart, ZoneKeptClear, NeverTouches, InOrder, EveryStepCounts),
}
_IMAGES = tuple[tuple[str, PromptFill], ...]  # a mapping in files
_MAX_NUMBER = 100.0  # metres, radians and factors
_WORD = re.compile(r"\w[\w.+-]{0,99}")


def save_episode(episode: Episode, path: str | Path) -> Path:
    """Save an episode as a readable file; `load_episode` returns an equal one.

    Args:
        episode: A sampled or composed episode.
        path: File ending in .yaml, .yml or .json.

    Returns:
        The path.

    Raises:
        InputFileError: The path ends in none of these, the episode has a goal of a class of one's own, or
            `load_episode` would refuse it; no file is written.
    """
    path = as_path(path)
    is_json, values = _checked_suffix(path) == ".json", _encode(episode, Episode)
    try:
        episode_from_values(values)
    except OpenVimaError as error:
        raise InputFileError(f"the episode cannot be saved, for it could not be loaded: {error}") from None
    if is_json:
        text = json.dumps(values, indent=1, ensure_ascii=False) + "\n"
    else:
        text = yaml.safe_dump(values, sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)
    return atomic_write_file(path, text)


def load_episode(path: str | Path, *, assets: str | Path | Assets = "procedural") -> Episode:
    """Load an episode from a YAML or JSON file.

    Args:
        path: A file by `save_episode`, or a scene written by hand with the arguments of `compose`. PNG files
            are relative to its folder and must be inside.
        assets: Asset pack, for the rest heights of a scene written by hand.

    Raises:
        InputFileError: The file cannot be read, or holds no valid episode; the message names the field.
        SceneError, UnknownNameError: The scene is not possible.
        ConfigError: The seed of the episode is not allowed, or a function for the assets fails.
    """
    path = as_path(path)
    read = read_json if _checked_suffix(path) == ".json" else read_yaml
    try:
        values = read(path, max_bytes=MAX_EPISODE_BYTES)
    except OSError as error:
        raise InputFileError(f"episode {str(path)!r} cannot be read: {error.strerror or error}.") from None
    try:
        return episode_from_values(values, assets=assets, folder=path.parent)
    except OpenVimaError as error:
        raise type(error)(f"{path.name}: {error}") from None


def episode_from_values(
    values: object, *, assets: str | Path | Assets = "procedural", folder: Path | None = None
) -> Episode:
    """Read an episode from the plain values of a file.

    Args:
        values: All fields of an episode, or the arguments of `compose`.
        assets: Asset pack.
        folder: Folder of PNG files; None: there may be none.

    Raises:
        InputFileError, SceneError, UnknownNameError, ConfigError: As for
            `load_episode`.
    """
    if not isinstance(values, Mapping):
        raise InputFileError(f"an episode is {shown(values)}; it must be a mapping.")
    if "problem" in values:
        episode = _decode(values, Episode, "episode")
        _check(episode)
        return episode
    return composed(values, assets=load_assets(assets), photo=lambda name: _photo_beside(name, folder))


def _checked_suffix(path: Path) -> str:
    if (suffix := path.suffix.lower()) not in FORMATS:
        raise InputFileError(f"episode file {str(path)!r} must end in {', '.join(FORMATS)}.")
    return suffix


def _photo_beside(name: str, folder: Path | None) -> PhotoImage:
    """Read a PNG file in or below a folder, also after links are followed."""
    if folder is None:
        raise InputFileError(f"photo {shown(name)} needs an episode file to be relative to.")
    try:
        file = (folder / name).resolve()
        inside = not Path(name).is_absolute() and file.is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):  # too long, null bytes, loops of links
        file, inside = folder, False
    if not inside:
        raise InputFileError(f"photo {shown(name)} must be inside the folder of the episode file.")
    return read_photo(file)


def _encode(value: Any, kind: Any) -> Any:
    """Return plain values: records as mappings without fields that have their default."""
    if kind in _KINDS and type(value) not in _KINDS[kind]:
        allowed = ", ".join(known.__name__ for known in _KINDS[kind])
        raise InputFileError(f"a {type(value).__name__} cannot be saved in a file; allowed are {allowed}.")
    if is_dataclass(value):
        hints = typing.get_type_hints(type(value))
        tag = {"type": type(value).__name__} if kind in _KINDS else {}
        return tag | {
            field.name: _encode(getattr(value, field.name), hints[field.name])
            for field in fields(value)
            if field.default is MISSING or getattr(value, field.name) != field.default
        }
    if kind == _IMAGES:
        return {name: _encode(fill, PromptFill) for name, fill in value}
    if isinstance(value, tuple | list):
        kinds = _entry_kinds(kind, len(value))
        return [_encode(entry, entry_kind) for entry, entry_kind in zip(value, kinds, strict=True)]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode("ascii")
    return value.item() if isinstance(value, np.generic) else value


def _entry_kinds(kind: Any, count: int) -> Sequence[Any]:
    """Annotations of a tuple's entries."""
    arguments = typing.get_args(_without_none(kind))
    return [arguments[0]] * count if arguments[-1] is Ellipsis else arguments


def _without_none(kind: Any) -> Any:
    """The kind of an optional field."""
    arguments = typing.get_args(kind)
    if type(None) in arguments and len(arguments) == 2:
        return next(argument for argument in arguments if argument is not type(None))
    return kind


_NAMES = {
    float: f"a number from {-_MAX_NUMBER:g} to {_MAX_NUMBER:g}",
    int: "a whole number",
    bool: "true or false",
    str: "text",
    bytes: "base64 text",
}


def _decode(value: Any, kind: Any, where: str) -> Any:
    """Return the value of an annotation; the inverse of `_encode`, for values that nobody has checked."""
    if (inner := _without_none(kind)) is not kind:
        return None if value is None else _decode(value, inner, where)
    origin, wanted = typing.get_origin(kind), "a mapping"
    if isinstance(value, Mapping) and kind == _IMAGES:
        return tuple((name, _decode(fill, PromptFill, f"{where}.{name}")) for name, fill in value.items())
    if isinstance(value, Mapping) and (kind in _KINDS or is_dataclass(kind)):
        return _record(value, kind, where)
    if origin is tuple and kind != _IMAGES:
        wanted = "a list"
        if isinstance(value, list | tuple):
            kinds = _entry_kinds(kind, len(value))
            if len(kinds) == len(value):
                pairs = enumerate(zip(value, kinds, strict=True))
                return tuple(_decode(entry, each, f"{where}[{n}]") for n, (entry, each) in pairs)
            wanted = f"a list of {len(kinds)}"
    elif origin is typing.Literal:
        if value in typing.get_args(kind):
            return value
        wanted = f"one of {', '.join(typing.get_args(kind))}"
    elif kind in _NAMES:
        wanted = _NAMES[kind]
        is_float = kind is float and not isinstance(value, bool)
        if is_float and isinstance(value, int | float) and abs(value) <= _MAX_NUMBER:  # NaN is not
            return float(value)
        if kind is bytes and isinstance(value, str):
            with contextlib.suppress(ValueError):
                return base64.b64decode(value, validate=True)
        if kind in (int, bool, str) and type(value) is kind:
            return value
    raise InputFileError(f"{where} is {shown(value)}; it must be {wanted}.")


def _record(value: Mapping[str, Any], kind: Any, where: str) -> Any:
    if kind in _KINDS:
        known = {each.__name__: each for each in _KINDS[kind]}
        if value.get("type") not in known:
            raise InputFileError(f"{where}: {unknown_name('type', value.get('type'), known)}")
        kind, value = known[value["type"]], {k: v for k, v in value.items() if k != "type"}
    hints = typing.get_type_hints(kind)
    if unknown := [name for name in value if name not in hints]:
        raise InputFileError(f"{where}: {unknown_name('field', unknown[0], hints)}")
    required = [field.name for field in fields(kind) if field.default is MISSING]
    if missing := [name for name in required if name not in value]:
        raise InputFileError(f"{where} has no {missing[0]}.")
    try:
        return kind(**{name: _decode(entry, hints[name], f"{where}.{name}") for name, entry in value.items()})
    except InputFileError:
        raise
    except OpenVimaError as error:
        raise InputFileError(f"{where}: {error}") from None


def _check(episode: Episode) -> None:
    """Check what the types of the fields leave open.

    Raises:
        InputFileError, SceneError, UnknownNameError, ConfigError: It is not valid.
    """
    for name in ("max_steps", "oracle_max_steps"):
        if not 1 <= getattr(episode, name) <= MAX_STEPS:
            raise InputFileError(f"{name} is {getattr(episode, name)}; it must be 1 to {MAX_STEPS}.")
    for name, value, known in (("level", episode.level, LEVELS), ("domain", episode.domain, DOMAINS)):
        if value not in known:
            raise InputFileError(unknown_name(name, value, known))
    if not _WORD.fullmatch(episode.task):
        raise InputFileError(f"task is {echo(repr(episode.task))}; give a plain name.")
    checked_seed(episode.seed)
    problem = episode.problem
    _check_scene(problem.scene, FIRST_OBJECT_ID[problem.scene.end_effector], "scene")
    for name, fill in problem.prompt.images:
        if isinstance(fill, SceneImage):
            _check_scene(fill.scene, 2, f"image {name!r}")
        elif isinstance(fill, ObjectImage):
            _check_placement(fill.placement)


def _check_scene(scene: Scene, first_id: int, label: str) -> None:
    if not len(scene.placements) <= MAX_OBJECTS:
        raise InputFileError(
            f"{label} has {len(scene.placements)} objects; at most {MAX_OBJECTS} are allowed."
        )
    for placement in scene.placements:
        what = f"{label}, object {placement.id}"
        if not first_id <= placement.id <= 254:
            raise InputFileError(f"{what}: ids must be {first_id} to 254.")
        _check_placement(placement)


def _check_placement(placement: Placement) -> None:
    object_spec(placement.object)
    texture_spec(placement.texture)
