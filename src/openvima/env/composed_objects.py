"""Objects of composed scenes: checks of what users give, placement at rest, refusal of what does not fit."""

import math
import re
import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any  # of whatever type a user gives

import numpy as np

from openvima.catalog import OBJECT_SETS, Assets, object_spec, texture_spec
from openvima.errors import SceneError, UnknownNameError, echo, unknown_name
from openvima.perception.objects import MAX_OBJECTS
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Placement, Pose, in_workspace
from openvima.tasks.table import CELL_M, TableSampler


def shown(value: object) -> str:
    """Return a value for an error, in 80 characters at most."""
    return echo(reprlib.repr(value), 80)


def entries(value: object, label: str) -> Sequence[Any]:
    """Return a list or tuple.

    Raises:
        SceneError: It is none.
    """
    if not isinstance(value, Sequence) or isinstance(value, str | bytes):
        raise SceneError(f"{label} is {shown(value)}; give a list.")
    return value


def number(value: Any, label: str, low: float, high: float) -> float:
    """Return a finite number within limits.

    Raises:
        SceneError: It is none, or outside.
    """
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not low <= value <= high:  # NaN lies nowhere
        raise SceneError(f"{label} is {shown(value)}; give a number from {low:g} to {high:g}.")
    return float(value)


def pair(value: Any, label: str) -> tuple[float, float]:
    """Return x and y in metres.

    Raises:
        SceneError: These are not two finite numbers.
    """
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, Sequence) or isinstance(value, str | bytes) or len(value) != 2:
        raise SceneError(f"{label} is {shown(value)}; give x and y in metres, as in [0.45, -0.25].")
    x, y = (number(coordinate, label, -1e6, 1e6) for coordinate in value)
    return x, y


def known_object(handle: object, handles: Mapping[str, Placement], label: str) -> Placement:
    """Return the object of a handle or an index.

    Raises:
        SceneError: The scene has no such object.
    """
    if type(handle) is int and 0 <= handle < len(handles):
        return list(handles.values())[handle]
    if isinstance(handle, str) and handle in handles:
        return handles[handle]
    raise SceneError(f"{label}: {unknown_name('object', handle, handles, handles_hint(handles))}")


def handles_hint(handles: Mapping[str, Placement]) -> str:
    """Return a sentence with all handles."""
    return f"The scene has {echo(', '.join(handles))}."


SCALES = (0.5, 2.0)
MAX_ANGLE_DEG = 3600
WORKSPACE = (
    f"x must lie in {WORKSPACE_LOW[0]} … {WORKSPACE_HIGH[0]} m "
    f"and y in {WORKSPACE_LOW[1]} … {WORKSPACE_HIGH[1]} m"
)
FIXED_OBJECTS = frozenset(
    {*OBJECT_SETS["B_all"], *OBJECT_SETS["bounds"], *OBJECT_SETS["constraint"], "stand"}
)
_LETTERS = "abcdefghijklmnopqrstuvwxyz"
_SLACK_M = 1e-9


@dataclass(frozen=True, slots=True)
class SceneObject:
    """An object of a composed scene.

    Args:
        object: Display name in the catalogue, such as "heart".
        texture: Display name in the catalogue, such as "red swirl".
        position: x, y of its link frame in metres.
        yaw_deg: Heading in degrees, counter-clockwise seen from above.
        name: Handle for prompt and goals; by default "a", "b", … in the order of the objects.
        scale: Factor on its size in the catalogue, 0.5 … 2.
        fixed: Whether it is fixed to the table; by default if it is a base, as in the tasks.
    """

    object: str
    texture: str
    position: tuple[float, float]
    yaw_deg: float = 0.0
    name: str = ""
    scale: float = 1.0
    fixed: bool | None = None


ObjectLike = SceneObject | Mapping[str, Any] | Sequence[Any]
FIELDS = tuple(field.name for field in fields(SceneObject))


def scene_objects(given: object) -> list[SceneObject]:
    """Read the objects, each with its handle.

    Raises:
        SceneError: An object is malformed, or two have one name.
        UnknownNameError: The catalogue has no such object or texture.
    """
    if isinstance(given, Mapping):
        named = [scene_object(value, f"object {shown(name)}", name) for name, value in given.items()]
    else:
        listed = entries(given, "objects")
        labels = [*_LETTERS, *(f"object{n}" for n in range(len(_LETTERS), len(listed)))]
        named = [
            scene_object(value, f"object {n} ({label!r})", label)
            for n, (label, value) in enumerate(zip(labels, listed, strict=False))
        ]
    if not 1 <= len(named) <= MAX_OBJECTS:
        raise SceneError(f"there are {len(named)} objects; a scene has 1 to {MAX_OBJECTS}.")
    names = [each.name for each in named]
    for n, name in enumerate(names):
        if not re.fullmatch(r"\w{1,40}", name):
            raise SceneError(
                f"object {n} is named {shown(name)}; use 1 to 40 letters, digits and underscores."
            )
        if name in names[:n]:
            raise SceneError(
                f"objects {names.index(name)} and {n} are both named {name!r}; names are unique."
            )
    return named


def scene_object(given: object, label: str, default_name: object) -> SceneObject:
    """Read one object in any of its forms and check all its fields.

    Args:
        given: A `SceneObject`, a mapping of its fields, or `(object, texture, (x, y)[, yaw_deg])`.
        label: Name of the object in errors.
        default_name: Its handle if it has none of its own.

    Raises:
        SceneError: It is malformed.
        UnknownNameError: The catalogue has no such object or texture.
    """
    if isinstance(given, SceneObject):
        values: dict[str, Any] = {name: getattr(given, name) for name in FIELDS}
    elif isinstance(given, Mapping):
        values = dict(given)
        if unknown := [key for key in values if key not in FIELDS]:
            raise SceneError(f"{label}: {unknown_name('field', unknown[0], FIELDS)}")
    else:
        parts = entries(given, label)
        values = dict(zip(FIELDS[:4], parts, strict=False))
        if not 3 <= len(parts) <= 4:
            raise SceneError(f"{label} has {len(parts)} entries; give (object, texture, (x, y)[, yaw_deg]).")
    if missing := [name for name in FIELDS[:3] if name not in values]:
        raise SceneError(f"{label} has no {missing[0]}; it needs {', '.join(FIELDS[:3])}.")
    if not isinstance(name := values.pop("name", "") or default_name, str):
        raise SceneError(f"{label}: name is {shown(name)}; give text.")
    x, y = pair(values.pop("position"), f"{label}: position")
    yaw_deg = number(values.pop("yaw_deg", 0.0), f"{label}: yaw_deg", -MAX_ANGLE_DEG, MAX_ANGLE_DEG)
    scale = number(values.pop("scale", 1.0), f"{label}: scale", *SCALES)
    if not isinstance(fixed := values.pop("fixed", None), bool | None):
        raise SceneError(f"{label}: fixed is {shown(fixed)}; give true or false.")
    object_name, texture = checked_appearance(values["object"], values["texture"], label)
    return SceneObject(object_name, texture, (x, y), yaw_deg, name, scale, fixed)


def checked_appearance(object_name: object, texture: object, label: str) -> tuple[str, str]:
    """Check the names of an object and its texture.

    Raises:
        UnknownNameError: The catalogue has no such object or texture.
        SceneError: A name is no text.
    """
    if not isinstance(object_name, str) or not isinstance(texture, str):
        raise SceneError(f"{label} is {shown(object_name)} of texture {shown(texture)}; give two names.")
    try:
        return object_spec(object_name).name, texture_spec(texture).name
    except UnknownNameError as error:
        raise type(error)(f"{label}: {error}") from None


def add_object(table: TableSampler, given: SceneObject, handles: Mapping[str, Placement]) -> Placement:
    """Place an object at rest on the table, inside the workspace and clear of all others.

    Raises:
        SceneError: It is outside the workspace or overlaps another object.
    """
    new = put(table, given)
    check_inside(new, table.assets, described(given.name, new))
    covered = table.covered(new)
    for name, other in handles.items():
        area_m2 = float((covered & table.covered(other)).sum()) * CELL_M**2
        if area_m2:
            apart_m = _reach_m(new, table.assets) + _reach_m(other, table.assets)
            raise SceneError(
                f"{described(given.name, new)} at {_at(new)} overlaps {described(name, other)} at "
                f"{_at(other)} by {1e4 * area_m2:.1f} cm² of the table; 0 is allowed, and {apart_m:.2f} m "
                "between their positions always suffice."
            )
    return new


def put(table: TableSampler, given: SceneObject, *, on_top: bool = False) -> Placement:
    """Place an object at rest on the table, or on top of the objects below."""
    spec = object_spec(given.object)
    return table.add(
        given.object,
        given.texture,
        size=spec.size_max,
        pose=Pose.planar(*given.position, math.radians(given.yaw_deg)),
        fixed=(given.object in FIXED_OBJECTS or spec.container) if given.fixed is None else given.fixed,
        scale=(given.scale, given.scale, given.scale),
        on_top=on_top,
    )


def check_inside(placement: Placement, assets: Assets, label: str) -> None:
    """Check that position and outline are in the workspace.

    Raises:
        SceneError: They are not.
    """
    if not in_workspace(placement.pose):
        raise SceneError(f"{label} is at {_at(placement)}; {WORKSPACE}.")
    corners = outline(placement, assets)
    low, high = corners.min(axis=0), corners.max(axis=0)
    for axis, name in enumerate("xy"):
        for edge in (low[axis], high[axis]):
            if not WORKSPACE_LOW[axis] - _SLACK_M <= edge <= WORKSPACE_HIGH[axis] + _SLACK_M:
                raise SceneError(
                    f"{label} at {_at(placement)} reaches {name} = {edge:.3f} m with its edge; {WORKSPACE}."
                )


def outline(placement: Placement, assets: Assets) -> np.ndarray:
    """Return the corners of an object's mesh on the table, shape (N, 2), metres."""
    geometry = assets.geometry(placement.object, placement.size, placement.scale)
    return placement.pose.transform(geometry.visual.vertices.reshape(-1, 3))[:, :2]


def _reach_m(placement: Placement, assets: Assets) -> float:
    """Largest planar distance of an object's mesh from its position."""
    offsets = outline(placement, assets) - (placement.pose.x, placement.pose.y)
    return float(np.hypot(*offsets.T).max())


def described(name: str, placement: Placement) -> str:
    """Return "object 'a' (red swirl heart)" for an error."""
    return f"object {name!r} ({placement.texture} {placement.object})"


def _at(placement: Placement) -> str:
    return f"({placement.pose.x:.3g}, {placement.pose.y:.3g})"
