"""Composed episodes: scenes, prompts, photos and goals of users, checked and placed at rest."""

import inspect
import itertools
import math
import re
import reprlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from string import ascii_lowercase
from typing import Any  # of whatever type a user gives; checked here

import numpy as np
from PIL import Image

from openvima.catalog import OBJECT_SETS, Assets, Pool, load_assets, object_spec, texture_spec
from openvima.catalog.objects import FULL_SYMMETRY, NO_SYMMETRY
from openvima.errors import InputFileError, SceneError, UnknownNameError, echo, unknown_name
from openvima.input_files import decode_png, read_png
from openvima.perception.objects import MAX_OBJECTS
from openvima.perception.preprocessing import image_names
from openvima.render.rasteriser import PHOTO_WHITE
from openvima.scene import (
    COMPOSED,
    END_EFFECTORS,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    AtPose,
    EndEffector,
    Episode,
    Goal,
    InZone,
    ObjectImage,
    PhotoImage,
    Placement,
    Point,
    Pose,
    Problem,
    Prompt,
    PromptFill,
    SceneImage,
    Tolerance,
    Zone,
    in_workspace,
)
from openvima.scene.goal import is_condition
from openvima.scene.prompt import PHOTO_SIDE
from openvima.tasks.placing import TOLERANCE, TOLERANCE_DEG, rotation_goal
from openvima.tasks.sweep_table import MAGNIFICATION
from openvima.tasks.table import TableSampler

Handles = Mapping[str, Placement]


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


def pair(value: Any, label: str) -> Point:
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


def known_object(handle: object, handles: Handles, label: str) -> Placement:
    """Return the object of a handle or an index.

    Raises:
        SceneError: The scene has no such object.
    """
    if type(handle) is int and 0 <= handle < len(handles):
        return list(handles.values())[handle]
    if isinstance(handle, str) and handle in handles:
        return handles[handle]
    raise SceneError(f"{label}: {unknown_name('object', handle, handles)}")


SCALES = (0.5, 2.0)
MAX_ANGLE_DEG = 3600
WORKSPACE = (
    f"x must lie in {WORKSPACE_LOW[0]} … {WORKSPACE_HIGH[0]} m "
    f"and y in {WORKSPACE_LOW[1]} … {WORKSPACE_HIGH[1]} m"
)
_FIXED_OBJECTS = frozenset(
    {*OBJECT_SETS["B_all"], *OBJECT_SETS["bounds"], *OBJECT_SETS["constraint"], "stand"}
)
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
    position: Point
    yaw_deg: float = 0.0
    name: str = ""
    scale: float = 1.0
    fixed: bool | None = None


def default_names() -> Iterator[str]:
    """Yield the handles of objects that have none: a to z, then object26 and so on."""
    yield from ascii_lowercase
    yield from map("object{}".format, itertools.count(len(ascii_lowercase)))


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
        pairs = zip(default_names(), entries(given, "objects"), strict=False)
        named = [
            scene_object(value, f"object {n} ({label!r})", label) for n, (label, value) in enumerate(pairs)
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
        values: dict[str, Any] = asdict(given)
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


def add_object(table: TableSampler, given: SceneObject, handles: Handles) -> Placement:
    """Place an object at rest on the table, inside the workspace and clear of all others.

    Raises:
        SceneError: It is outside the workspace or overlaps another object.
    """
    new = put(table, given)
    check_inside(new, table.assets, described(given.name, new))
    covered = table.covered(new)
    for name, other in handles.items():
        if (covered & table.covered(other)).any():
            raise SceneError(
                f"{described(given.name, new)} at {_position_text(new)} overlaps {described(name, other)} at "
                f"{_position_text(other)}; objects must not cover one another."
            )
    return new


def put(table: TableSampler, given: SceneObject, *, on_top: bool = False) -> Placement:
    """Place an object at rest on the table, or on top of the objects below."""
    return table.add(
        given.object,
        given.texture,
        size=object_spec(given.object).size_max,
        pose=Pose.planar(*given.position, math.radians(given.yaw_deg)),
        fixed=given.object in _FIXED_OBJECTS if given.fixed is None else given.fixed,
        scale=(given.scale, given.scale, given.scale),
        on_top=on_top,
    )


def check_inside(placement: Placement, assets: Assets, label: str) -> None:
    """Check that the outline is in the workspace.

    Raises:
        SceneError: It is not.
    """
    low, high = _extent(placement, assets)
    for axis, name in enumerate("xy"):
        for edge in (low[axis], high[axis]):
            if not WORKSPACE_LOW[axis] - _SLACK_M <= edge <= WORKSPACE_HIGH[axis] + _SLACK_M:
                raise SceneError(
                    f"{label} at {_position_text(placement)} reaches {name} = {edge:.3f} m with its edge; "
                    f"{WORKSPACE}."
                )


def _extent(placement: Placement, assets: Assets) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest x and y of an object's mesh, metres."""
    vertices = placement.geometry(assets).visual.vertices
    corners = placement.pose.transform(vertices.reshape(-1, 3))[:, :2]
    return corners.min(axis=0), corners.max(axis=0)


def described(name: str, placement: Placement) -> str:
    """Return "object 'a' (red swirl heart)" for an error."""
    return f"object {name!r} ({placement.texture} {placement.object})"


def _position_text(placement: Placement) -> str:
    return f"({placement.pose.x:.3g}, {placement.pose.y:.3g})"


MAX_PNG_BYTES = 32 * 2**20
MAX_PNG_SIDE = 4096  # pixels


def read_photo(file: Path) -> PhotoImage:
    """Read a PNG file with an object on white or transparent background.

    The background is cut off; the rest is resized to the size of rendered prompt objects.

    Raises:
        InputFileError: There is no such file, it is no regular file, no PNG, too large, or empty.
    """
    try:
        picture = read_png(file, max_bytes=MAX_PNG_BYTES, max_side=MAX_PNG_SIDE)
    except InputFileError as error:
        raise InputFileError(f"photo {error}") from None
    return _photo(picture, f"photo {str(file)!r}")


def photo_from_bytes(content: bytes) -> PhotoImage:
    """Read the content of a PNG file; see `read_photo`.

    Raises:
        InputFileError: It is no PNG, too large, or empty.
    """
    label = "the photo"
    return _photo(decode_png(content, label, max_bytes=MAX_PNG_BYTES, max_side=MAX_PNG_SIDE), label)


def _photo(picture: Image.Image, label: str) -> PhotoImage:
    """Cut a picture to its object and resize it so that its longer side is `PHOTO_SIDE`."""
    paper = Image.new("RGBA", picture.size, "white")
    pixels = np.asarray(Image.alpha_composite(paper, picture).convert("RGB"))
    is_object = (pixels < PHOTO_WHITE).any(axis=-1)
    if not is_object.any():
        raise InputFileError(f"{label} is all white; it must show an object on white.")
    rows, columns = np.flatnonzero(is_object.any(axis=-1)), np.flatnonzero(is_object.any(axis=0))
    cut = Image.fromarray(pixels[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1])
    scale = PHOTO_SIDE / max(cut.size)
    width, height = (max(1, round(side * scale)) for side in cut.size)
    how = Image.Resampling.BOX if scale < 1 else Image.Resampling.NEAREST
    return PhotoImage(width, height, cut.resize((width, height), how).tobytes())


# The angles of the catalogue are those of the benchmark, which differ from the shapes or are unset for these.
_SYMMETRY_RAD = {
    **dict.fromkeys(("block", "shorter block", "small block", "cross"), math.pi / 2),
    **dict.fromkeys(("triangle", "pan"), NO_SYMMETRY),
    **dict.fromkeys(("round", "disk"), FULL_SYMMETRY),
}


def _goal(given: Any, label: str, handles: Handles, end_effector: EndEffector, assets: Assets) -> Goal:
    if is_condition(given):
        return given
    allowed = f"Allowed: {'; '.join(_usage(known) for known in _GOALS)}."
    if not isinstance(given, Sequence) or isinstance(given, str) or not given:
        raise SceneError(f"{label} is {shown(given)}; give a list of goals. {allowed}")
    name, *arguments = given
    if not isinstance(name, str) or name not in _GOALS:
        raise SceneError(f"{label}: {unknown_name('goal', name, _GOALS, allowed)}")
    make = _GOALS[name]
    needed = "spatula" if make is _swept_into else "suction"
    if end_effector != needed:
        raise SceneError(f"{label}: {name!r} needs the end effector {needed}, not {end_effector}.")
    parameters = inspect.signature(make).parameters
    try:
        bound = inspect.signature(make).bind(*arguments, assets=assets)
    except TypeError:
        raise SceneError(f"{label} has other arguments than {_usage(name)}. {allowed}") from None
    for parameter in ("a", "b"):
        if parameter in parameters:
            bound.arguments[parameter] = known_object(bound.arguments[parameter], handles, label)
    moved = bound.arguments["a"]
    if moved.fixed:
        raise SceneError(f"{label} ({name}): the {moved.texture} {moved.object} is fixed to the table.")
    if moved is bound.arguments.get("b"):
        raise SceneError(
            f"{label} ({name}): {moved.texture} {moved.object} cannot be in itself; name two objects."
        )
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
    return AtPose.into(a, b, TOLERANCE)


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
    if abs(math.remainder(b.pose.yaw_rad, math.pi / 2)) > 1e-6:
        yaw_deg = math.degrees(b.pose.yaw_rad)
        raise SceneError(f"the {b.object} has a yaw of {yaw_deg:.1f} degrees; it must be a multiple of 90.")
    low, high = _extent(b, assets)
    (x, y), (size_x, size_y) = ((low + high) / 2).tolist(), np.subtract(high, low).tolist()
    return InZone(a.id, Zone(x, y, size_x, size_y), relative_to=b.id)


_GOALS: dict[str, Callable[..., Goal]] = {
    "in": _in,
    "at": _at,
    "rotated": _rotated,
    "swept_into": _swept_into,
}


MAX_PROMPT_CHARS = 1000


def _fill(
    slot: str, given: object, handles: Handles, table: TableSampler, photo: Callable[[str], PhotoImage]
) -> PromptFill:
    """Make the image of a placeholder.

    Raises:
        SceneError: It is none of the allowed forms.
    """
    label = f"image {slot!r}"
    if isinstance(given, ObjectImage | SceneImage | PhotoImage):
        return given
    if isinstance(given, Path) or (isinstance(given, str) and given.lower().endswith(".png")):
        try:
            return photo(str(given))
        except InputFileError as error:
            raise InputFileError(f"{label}: {error}") from None
    if isinstance(given, str) or type(given) is int:
        return _object_image(known_object(given, handles, label))
    parts = entries(given, label)
    if len(parts) == 2 and all(isinstance(part, str) for part in parts):
        name, texture = checked_appearance(parts[0], parts[1], label)
        pose = Pose.planar(0.5, 0.0)
        return _object_image(Placement(0, name, texture, object_spec(name).size_max, pose))
    if not 1 <= len(parts) <= MAX_OBJECTS:
        raise SceneError(f"{label} shows {len(parts)} objects; a scene has 1 to {MAX_OBJECTS}.")
    shown_table = table.blank()
    for n, entry in enumerate(parts):
        known = _moved(entry, f"{label}, object {n}", handles)
        placed = put(shown_table, known, on_top=True)  # what overlaps lies on top
        check_inside(placed, table.assets, f"{label}, object {n} ({known.texture} {known.object})")
    return SceneImage.of(shown_table.placements)


def _moved(entry: object, label: str, handles: Handles) -> SceneObject:
    """Read an object of a prompt scene: one of its own, or one of the scene at another position."""
    is_moved = (
        isinstance(entry, Sequence)
        and not isinstance(entry, str)
        and 2 <= len(entry) <= 3
        and not isinstance(entry[1], str)
    )
    if not is_moved:
        return scene_object(entry, label, "")
    handle, position, *yaw = entry  # type: ignore[misc]  # a sequence, as checked
    known = known_object(handle, handles, label)
    yaw_deg = yaw[0] if yaw else math.degrees(known.pose.yaw_rad)
    moved = (known.object, known.texture, position, yaw_deg)
    values = dict(zip(FIELDS[:4], moved, strict=True))
    return scene_object({**values, "scale": known.scale[0]}, label, "")


def _object_image(placement: Placement) -> ObjectImage:
    return ObjectImage(placement, MAGNIFICATION if placement.object == "small block" else 1.0)


def _prompt_parts(text: object, images: object, handles: Handles) -> tuple[str, dict[str, Any]]:
    """Return the text of a prompt, and what a user gives for the image of each placeholder.

    Raises:
        SceneError: The text is malformed, or a placeholder has no image.
    """
    if isinstance(text, str) and len(text) <= 2 * MAX_PROMPT_CHARS and not text.isprintable():
        text = " ".join(text.split())  # other blanks than the space, such as ends of lines, become one
    if not isinstance(text, str) or not text.strip() or len(text) > MAX_PROMPT_CHARS:
        raise SceneError(
            f"prompt is {shown(text)}; give 1 to {MAX_PROMPT_CHARS} characters, not blanks alone, such as "
            "'Put the {a} into the {b}.'"
        )
    if not isinstance(images, Mapping | None):
        raise SceneError(f"images is {shown(images)}; give a mapping of placeholders to images.")
    slots = image_names(text)
    given = dict(images or {})
    if unused := [name for name in given if name not in slots]:
        raise SceneError(unknown_name("placeholder in the prompt for image", unused[0], slots))
    for slot in slots:
        if slot not in given and slot not in handles:
            what = "image or object for placeholder"
            raise SceneError(unknown_name(what, slot, handles))
    return text, {slot: given.get(slot, slot) for slot in slots}


COMPOSE_KEYS = ("objects", "prompt", "images", "goals", "max_steps", "end_effector")
DEFAULT_MAX_STEPS, MAX_STEPS_WITHOUT_GOALS = 10, 3
MAX_STEPS = 1000
_POOL = Pool((), (), (), ())


def compose(
    objects: Mapping[str, ObjectLike] | Sequence[ObjectLike],
    prompt: str,
    *,
    images: Mapping[str, Any] | None = None,
    goals: Sequence[Any] = (),
    max_steps: int | None = None,
    end_effector: str = "suction",
    assets: str | Path | Assets = "procedural",
) -> Episode:
    """Compose an episode from a scene and a prompt of one's own.

    Args:
        objects: The objects, each `(object, texture, (x, y))`, with the heading in degrees as an optional
            fourth entry, or a `SceneObject`, or a mapping of its fields. In a mapping, the keys are their
            handles; in a list, the handles are "a", "b", … unless an object has a name.
        prompt: The text with a `{placeholder}` for each image.
        images: Content of placeholders that are not handles: a handle or an index into the objects;
            `(object, texture)` of the catalogue; the path of a PNG file with an object on white; or a list of
            objects for an image of a whole scene, each as in `objects` or `(handle, (x, y))` for an object of
            the scene somewhere else.
        goals: Goals in the order of the oracle: `("in", a, b)`, which holds on b too, `("at", a, (x, y))`,
            `("rotated", a, degrees)` clockwise, `("swept_into", a, b)`; or goals of `openvima.scene`. Without
            goals the episode ends at the step limit only.
        max_steps: Step limit, 1 … 1000; by default 10, and 3 without goals.
        end_effector: "suction", or "spatula" for sweeps.
        assets: Asset pack.

    Returns:
        The episode.

    Raises:
        SceneError: An object is malformed, outside the workspace or overlaps another; the prompt, an image
            or a goal is malformed. The message names the object and the limit.
        UnknownNameError: The catalogue has no such object or texture.
        InputFileError: A PNG file cannot be used.

    Example:
        >>> objects = [("heart", "red swirl", (0.5, -0.2)), ("bowl", "green", (0.5, 0.2))]
        >>> compose(objects, "Put the {a} into the {b}.").problem.prompt.text
        'Put the {a} into the {b}.'
    """
    return composed(
        {"objects": objects, "prompt": prompt, "images": images, "goals": goals, "max_steps": max_steps}
        | {"end_effector": end_effector},
        assets=load_assets(assets),
        photo=lambda path: read_photo(Path(path)),
    )


def composed(values: Mapping[str, Any], *, assets: Assets, photo: Callable[[str], PhotoImage]) -> Episode:
    """Compose an episode from the arguments of `compose`, as a file holds them.

    Args:
        values: The arguments; any plain values.
        assets: Asset pack.
        photo: Reads a PNG file.

    Raises:
        SceneError, UnknownNameError, InputFileError: As for `compose`.
    """
    if unknown := [key for key in values if key not in COMPOSE_KEYS]:
        raise SceneError(unknown_name("key of a scene:", unknown[0], COMPOSE_KEYS))
    end_effector = values.get("end_effector", "suction")
    if end_effector not in END_EFFECTORS:
        raise SceneError(f"end_effector is {shown(end_effector)}; allowed: {', '.join(END_EFFECTORS)}.")
    max_steps = values.get("max_steps")
    if max_steps is None:
        max_steps = DEFAULT_MAX_STEPS if values.get("goals") else MAX_STEPS_WITHOUT_GOALS
    if type(max_steps) is not int or not 1 <= max_steps <= MAX_STEPS:
        raise SceneError(f"max_steps is {shown(max_steps)}; give a whole number from 1 to {MAX_STEPS}.")
    table = TableSampler(np.random.default_rng(0), _POOL, assets=assets, end_effector=end_effector)
    handles: dict[str, Placement] = {}
    for given in scene_objects(values.get("objects")):
        handles[given.name] = add_object(table, given, handles)
    listed = () if values.get("goals") is None else entries(values["goals"], "goals")
    text, images = _prompt_parts(values.get("prompt"), values.get("images"), handles)
    problem = Problem(
        table.scene(),
        Prompt(
            text, tuple((slot, _fill(slot, image, handles, table, photo)) for slot, image in images.items())
        ),
        tuple(_goal(each, f"goal {n}", handles, end_effector, assets) for n, each in enumerate(listed)),
    )
    return Episode(COMPOSED, "train", "user", 0, problem, oracle_max_steps=max_steps, max_steps=max_steps)
