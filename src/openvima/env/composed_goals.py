"""Goals of composed episodes by name."""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any  # of whatever type a user gives; checked here

import numpy as np

from openvima.catalog import Assets, object_spec
from openvima.catalog.objects import FULL_SYMMETRY, NO_SYMMETRY
from openvima.env.checked_values import entries, known_object, number, pair, shown
from openvima.env.composed_objects import MAX_ANGLE_DEG, WORKSPACE, outline
from openvima.errors import SceneError, unknown_name
from openvima.scene import AtPose, EndEffector, Goal, InZone, Placement, Pose, Tolerance, Zone, in_workspace
from openvima.scene.goal import is_condition
from openvima.tasks.into_base import TOLERANCE
from openvima.tasks.rotation import TOLERANCE_DEG, rotation_goal

Handles = Mapping[str, Placement]

# The angles of the catalogue are those of the benchmark, which differ from the shapes or are unset for these.
_SYMMETRY_RAD = {
    **dict.fromkeys(("block", "shorter block", "small block", "cross"), math.pi / 2),
    **dict.fromkeys(("triangle", "pan"), NO_SYMMETRY),
    **dict.fromkeys(("round", "disk"), FULL_SYMMETRY),
}


def composed_goals(
    given: object, handles: Handles, end_effector: EndEffector, assets: Assets
) -> tuple[Goal, ...]:
    """Make goals of what a user gives.

    Args:
        given: A list of goals, each its name and arguments, a mapping with the key "goal" and the arguments
            by name, or a goal of `openvima.scene`; None for no goals.
        handles: Objects of the scene.
        end_effector: Tool of the arm.
        assets: Asset pack.

    Raises:
        SceneError: A goal is unknown or malformed; the message lists the allowed ones.
    """
    listed = () if given is None else entries(given, "goals")
    return tuple(_goal(each, f"goal {n}", handles, end_effector, assets) for n, each in enumerate(listed))


def _goal(given: Any, label: str, handles: Handles, end_effector: EndEffector, assets: Assets) -> Goal:
    if is_condition(given):
        return given
    allowed = f"Allowed: {'; '.join(_usage(known) for known in _GOALS)}."
    if isinstance(given, Mapping):
        named = dict(given)
        name, arguments = named.pop("goal", None), ()
    elif isinstance(given, Sequence) and given and not isinstance(given, str):
        (name, *arguments), named = entries(given, label), {}
    else:
        raise SceneError(f"{label} is {shown(given)}; give a list of goals. {allowed}")
    if not isinstance(name, str) or name not in _GOALS:
        shown_name = name if isinstance(name, str) else shown(name)
        raise SceneError(f"{label}: {unknown_name('goal', shown_name, _GOALS, allowed)}")
    make = _GOALS[name]
    needed = "spatula" if make is _swept_into else "suction"
    if end_effector != needed:
        raise SceneError(f"{label}: {name!r} needs the end effector {needed}, not {end_effector}.")
    parameters = inspect.signature(make).parameters
    try:
        bound = inspect.signature(make).bind(*arguments, **named, assets=assets)
    except TypeError:
        raise SceneError(f"{label} has other arguments than {_usage(name)}. {allowed}") from None
    for parameter in ("a", "b"):
        if parameter in parameters:
            bound.arguments[parameter] = known_object(bound.arguments[parameter], handles, label)
    moved = bound.arguments["a"]
    if moved.fixed:
        raise SceneError(f"{label} ({name}): the {moved.texture} {moved.object} is fixed to the table.")
    try:
        return make(*bound.args, **bound.kwargs)
    except SceneError as error:
        raise SceneError(f"{label} ({name}, {moved.texture} {moved.object}): {error}") from None


def _usage(name: str) -> str:
    parameters = inspect.signature(_GOALS[name]).parameters.values()
    shown_ones = [
        p.name if p.default is p.empty else f"[{p.name}]" for p in parameters if p.kind is not p.KEYWORD_ONLY
    ]
    return f"({', '.join([name, *shown_ones])})"


def _in(a: Placement, b: Placement, *, assets: Assets) -> Goal:
    """The position of a is within 0.1 m of that of b, as in the tasks; so a is in b or on it."""
    _check_two_objects(a, b)
    return AtPose(a.id, b.pose, TOLERANCE, relative_to=b.id)


def _at(a: Placement, position: object, yaw_deg: object = None, *, assets: Assets) -> Goal:
    """The position of a is within 0.1 m of one on the table, and its heading within 15 degrees if given."""
    x, y = pair(position, "position")
    if not in_workspace(Pose((x, y, 0.0))):
        raise SceneError(f"position is ({x:.3g}, {y:.3g}); {WORKSPACE}.")
    if yaw_deg is None:
        return AtPose(a.id, Pose((x, y, a.pose.z), a.pose.quaternion), TOLERANCE)
    yaw_rad = math.radians(number(yaw_deg, "yaw_deg", -MAX_ANGLE_DEG, MAX_ANGLE_DEG))
    tolerance = Tolerance(TOLERANCE.position_m, math.radians(TOLERANCE_DEG))
    symmetry_rad = _SYMMETRY_RAD.get(a.object, object_spec(a.object).symmetry_rad)
    target = Pose.planar(x, y, yaw_rad, z=a.pose.z)
    return AtPose(a.id, target, tolerance, NO_SYMMETRY if symmetry_rad is None else symmetry_rad)


def _rotated(a: Placement, degrees: object, *, assets: Assets) -> Goal:
    """The object a is rotated in place, clockwise, within 15 degrees."""
    angle_deg = number(degrees, "degrees", -360, 360)
    if abs(math.remainder(angle_deg, 360)) <= TOLERANCE_DEG:
        raise SceneError(f"degrees is {angle_deg:g}; it must be more than {TOLERANCE_DEG}, the tolerance.")
    return rotation_goal(a, angle_deg, position_m=TOLERANCE.position_m)


def _swept_into(a: Placement, b: Placement, *, assets: Assets) -> Goal:
    """The small block a is inside the outline of b."""
    if a.object != "small block":
        raise SceneError(f"only a small block can be swept, not a {a.object}.")
    _check_two_objects(a, b)
    if abs(math.remainder(b.pose.yaw_rad, math.pi / 2)) > 1e-6:
        yaw_deg = math.degrees(b.pose.yaw_rad)
        raise SceneError(f"the {b.object} has a yaw of {yaw_deg:.1f} degrees; it must be a multiple of 90.")
    corners = outline(b, assets)
    low, high = corners.min(axis=0), corners.max(axis=0)
    (x, y), (size_x, size_y) = ((low + high) / 2).tolist(), np.subtract(high, low).tolist()
    return InZone(a.id, Zone(x, y, size_x, size_y), relative_to=b.id)


def _check_two_objects(a: Placement, b: Placement) -> None:
    if a.id == b.id:
        raise SceneError(f"{a.texture} {a.object} cannot be in itself; name two objects.")


_GOALS: dict[str, Callable[..., Goal]] = {
    "in": _in,
    "at": _at,
    "rotated": _rotated,
    "swept_into": _swept_into,
}
