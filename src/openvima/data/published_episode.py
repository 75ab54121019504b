"""One published episode: unpickling its files without running their code, and what it demonstrates.

A pickle is a program that may call any function. `read_pickle` runs it with a `pickle.Unpickler` that knows a
closed list of classes. Each is replaced by an inert stand-in that holds arguments and state; other names are
refused. Arrays and numbers are decoded from their stand-ins afterwards.
"""

import contextlib
import io
import pickle
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NoReturn

import numpy as np
from PIL import Image

from openvima.catalog import OBJECTS
from openvima.data.published_sources import PICKLES, frame_number
from openvima.data.records import Demonstration, versions_of
from openvima.data.schema import IMAGE_SHAPE, UNKNOWN_ID, VIEWS
from openvima.errors import MemberError, PromptError, unknown_name
from openvima.render import channels_first
from openvima.render.camera import TOP, project
from openvima.scene import (
    ACTION_SHAPES,
    END_EFFECTORS,
    Action,
    EndEffector,
    ObjectRecord,
    Outcome,
    PromptImage,
    RenderedPrompt,
)
from openvima.scene.scene import WORKSPACE_HIGH, WORKSPACE_LOW
from openvima.tasks import task_spec
from openvima.tasks.sampling import MAX_SEED

_MAX_TEXT = 200  # characters of a name or reason that a message quotes
# What `pickle` raises when it is given damaged bytes.
_DAMAGE_ERRORS = (
    *(pickle.UnpicklingError, LookupError, TypeError, ValueError, AttributeError, EOFError),
    *(ArithmeticError, MemoryError),
)
_DTYPE = re.compile(r"[<>|=]?[buif][1248]")

_NUMPY = ("numpy.core", "numpy._core")
_ENCYCLOPEDIA = tuple(f"{package}.tasks.components.encyclopedia" for package in ("vimasim", "vima_bench"))
ARRAYS = frozenset(f"{package}.multiarray._reconstruct" for package in _NUMPY)
BUFFERS = frozenset(f"{package}.numeric._frombuffer" for package in _NUMPY)  # arrays in protocol 5
SCALARS = frozenset(f"{package}.multiarray.scalar" for package in _NUMPY)
# Classes whose instances published files contain.
_CLASSES = frozenset(
    [
        *ARRAYS,
        *BUFFERS,
        *SCALARS,
        "numpy.dtype",
        "functools.partial",
        "collections.defaultdict",
        *(f"{module}.definitions.SizeRange" for module in _ENCYCLOPEDIA),
        *(f"{module}.profiles.ProfilePedia" for module in _ENCYCLOPEDIA),
        "omegaconf.listconfig.ListConfig",
        "omegaconf.dictconfig.DictConfig",
        "omegaconf.base.ContainerMetadata",
        "omegaconf.base.Metadata",
        *(f"omegaconf.nodes.{kind}Node" for kind in ("Any", "String", "Integer", "Boolean")),
    ]
)
# Classes and functions that published files only refer to.
_NAMES = frozenset(
    [
        "numpy.ndarray",
        *("builtins.dict", "builtins.list", "builtins.int"),
        *("typing.Any", "typing.Union", "typing.Optional"),
        *(
            f"{module}.replace_fns.{function}"
            for module in _ENCYCLOPEDIA
            for function in ("_kit_obj_common", "container_replace_fn", "_google_scanned_obj_common")
        ),
    ]
)


@dataclass(frozen=True)  # with slots, Python 3.11.2 would replace `__setstate__` by its own
class Global:
    """A class or function that a pickle only refers to, by its dotted name; nothing is imported."""

    name: str

    def __call__(self, *args: object) -> NoReturn:
        """Refuse to be called."""
        raise MemberError(f"it calls {self.name}, which no published file does; nothing was run.")

    def __setstate__(self, state: object) -> NoReturn:
        """Refuse to be changed."""
        raise MemberError(f"it changes {self.name}, which no published file does; nothing was run.")


class Record:
    """Stand-in for an instance of a class; it holds what the pickle says and does nothing.

    Args:
        args: Arguments of the constructor.
    """

    __slots__ = ("args", "state")
    name: ClassVar[str]  # dotted name of the class

    def __new__(cls, *args: object) -> "Record":
        """Hold the arguments; pickles also make instances without `__init__`."""
        record = super().__new__(cls)
        record.args, record.state = args, None
        return record

    def __setstate__(self, state: object) -> None:
        """Hold the state."""
        self.state = state

    def __setitem__(self, key: object, value: object) -> None:
        """Ignore the items of a mapping, which nothing reads."""


STAND_INS: dict[str, type[Record]] = {
    name: type(name.rpartition(".")[2], (Record,), {"__slots__": (), "name": name}) for name in _CLASSES
}


def read_pickle(content: bytes) -> Any:
    """Return the data in a pickle: plain values, lists, tuples, dictionaries, `Global` and `Record`.

    Args:
        content: The file.

    Raises:
        MemberError: It is damaged, or more than data.
    """
    try:
        return _Unpickler(io.BytesIO(content)).load()
    except MemberError:
        raise
    except _DAMAGE_ERRORS as error:
        reason = str(error)[:_MAX_TEXT] or type(error).__name__
        raise MemberError(f"it is truncated or no pickle of data ({reason}).") from None


class _Unpickler(pickle.Unpickler):
    """Finds stand-ins only."""

    def find_class(self, module: str, name: str) -> type[Record] | Global:
        """Return the stand-in of a class, or the name of what is never called."""
        dotted = f"{module}.{name}"
        if dotted in STAND_INS:
            return STAND_INS[dotted]
        if dotted in _NAMES:
            return Global(dotted)
        raise MemberError(f"it names {dotted[:_MAX_TEXT]}, which no published file needs; nothing was run.")


def as_array(value: object) -> np.ndarray:
    """Decode the stand-in of an array; the result is read-only.

    Raises:
        MemberError: It is none, holds anything but numbers, or its size does not fit its shape.
    """
    try:
        if isinstance(value, Record) and value.name in BUFFERS:
            content, dtype, shape, order, *axes = value.args
            array = _frombuffer(content, dtype).reshape(shape, order="C" if order == "K" else order)
            return array.transpose(*axes) if order == "K" else array
        if isinstance(value, Record) and value.name in ARRAYS and isinstance(value.state, tuple):
            _, shape, dtype, by_columns, content = value.state
            return _frombuffer(content, dtype).reshape(shape, order="F" if by_columns else "C")
    except MemberError:
        raise
    except (TypeError, ValueError, OverflowError):
        raise MemberError("it has an array whose size, shape and type do not fit each other.") from None
    raise MemberError(f"it has {describe_kind(value)} where an array should be.")


def as_plain(value: object) -> object:
    """Return the number in the stand-in of a NumPy scalar, and any other value as it is.

    Raises:
        MemberError: The number is damaged.
    """
    if not isinstance(value, Record) or value.name not in SCALARS:
        return value
    try:
        dtype, content = value.args
        return _frombuffer(content, dtype).reshape(()).item()
    except MemberError:
        raise
    except (TypeError, ValueError):
        raise MemberError("it has a number whose size and type do not fit.") from None


def describe_kind(value: object) -> str:
    """Describe a value in a word or two, without visiting nested values, which may be endless."""
    if value is None or isinstance(value, bool | int | float):
        return repr(value)
    if isinstance(value, str):
        return repr(value if len(value) <= 60 else value[:57] + "...")
    return value.name if isinstance(value, Global | Record) else f"a {type(value).__name__}"


def _frombuffer(content: object, dtype: object) -> np.ndarray:
    """View bytes as numbers; the result has the size of the bytes, whatever a file claims."""
    if not isinstance(dtype, Record) or dtype.name != "numpy.dtype":
        raise TypeError
    if not isinstance(content, bytes | bytearray):
        raise TypeError
    spec = dtype.args[0] if dtype.args else None
    if not isinstance(spec, str) or not _DTYPE.fullmatch(spec):
        raise MemberError(f"it has an array of type {describe_kind(spec)}; only numbers are read.")
    order = dtype.state[1] if isinstance(dtype.state, tuple) and len(dtype.state) > 1 else "|"
    numbers = np.dtype(spec)
    numbers = numbers.newbyteorder(">") if order == ">" else numbers
    return np.frombuffer(memoryview(content).toreadonly(), numbers)


# The original oracle chooses from a finer image, so at an edge its pixel can be a neighbour here.
_REACH_PX = 2
_AROUND = sorted(
    (
        (row, column)
        for row in range(-_REACH_PX, _REACH_PX + 1)
        for column in range(-_REACH_PX, _REACH_PX + 1)
    ),
    key=lambda offset: (offset[0] ** 2 + offset[1] ** 2, offset),
)


def infer_picks(segm: np.ndarray, actions: Sequence[Action], object_ids: Collection[int]) -> tuple[int, ...]:
    """Tell which object is where each action begins.

    Args:
        segm: Top view before each action, shape (T or more, 128, 256), uint8.
        actions: The T actions.
        object_ids: Ids of the objects; other values are floor, sheet and robot.

    Returns:
        T ids: of the pixel there, else of the nearest one within two pixels, else `schema.UNKNOWN_ID`.
    """
    points = np.array([(*action.pose0_position, 0.0) for action in actions])
    pixels = np.rint(project(points, TOP)).astype(int)
    return tuple(
        _find_nearest(image, pixel, object_ids)
        for image, pixel in zip(segm[: len(actions)], pixels, strict=True)
    )


def _find_nearest(image: np.ndarray, pixel: np.ndarray, object_ids: Collection[int]) -> int:
    height, width = image.shape
    for row_offset, column_offset in _AROUND:
        row, column = int(pixel[1]) + row_offset, int(pixel[0]) + column_offset
        if 0 <= row < height and 0 <= column < width and int(image[row, column]) in object_ids:
            return int(image[row, column])
    return UNKNOWN_ID


DOMAIN, LEVEL, ASSETS = "published", "train", "original"
_KINDS = ("object", "scene")

Fields = dict[str, Any]


def read_demonstration(files: Mapping[str, bytes], *, task: str, folder: str) -> Demonstration:
    """Make a demonstration of the files of an episode.

    Args:
        files: Path within the episode's folder to content.
        task: Today's name of the task.
        folder: Where it came from, such as "same_profile/000123"; becomes the outcome's reason.

    Returns:
        The demonstration. What the files do not tell is empty or `schema.UNKNOWN_ID`; `pick_ids` are inferred
        from what the top view shows where the tool goes down.

    Raises:
        MemberError: A file is missing, damaged or of another form; the message begins with its name.
    """
    observations, actions, trajectory = (_unpickle(files, name) for name in PICKLES)
    with _naming("action.pkl"):
        steps = _actions(actions)
    num_images = len(steps) + 1
    with _naming("obs.pkl"):
        segm = _segmentation(observations, num_images)
    with _naming("trajectory.pkl"):
        end_effector = _end_effector(trajectory, observations, num_images)
        objects = _objects(trajectory)
        prompt = _prompt(trajectory)
        seed = _whole_number(trajectory, "seed", MAX_SEED)
        _check_summary(trajectory, len(steps))
    return Demonstration(
        task=task,
        level=LEVEL,
        domain=DOMAIN,
        seed=seed,
        num_redraws=0,
        max_steps=task_spec(task).max_steps,
        prompt=prompt,
        rgb={view: _frames(files, f"rgb_{view}", num_images) for view in VIEWS},
        segm=segm,
        end_effector=end_effector,
        actions=steps,
        pick_ids=infer_picks(segm["top"], steps, [record.object_id for record in objects]),
        place_ids=(UNKNOWN_ID,) * len(steps),
        joint_paths=(),
        objects=objects,
        scenes=(),
        outcome=Outcome(success=True, reason=folder),
        assets=ASSETS,
        versions=package_versions(),
    )


def package_versions() -> dict[str, str]:
    """Return the versions of all packages that decide the bytes of an imported episode."""
    return dict(versions_of("numpy", "pillow", "pyarrow"))


@contextlib.contextmanager
def _naming(name: str) -> Iterator[None]:
    """Put the name of a file before messages about it."""
    try:
        yield
    except MemberError as error:
        raise MemberError(f"{name}: {error}") from None


def _unpickle(files: Mapping[str, bytes], name: str) -> Fields:
    if name not in files:
        raise MemberError(f"{name} is missing.")
    with _naming(name):
        fields = read_pickle(files[name])
        if not isinstance(fields, dict):
            raise MemberError(f"it holds {describe_kind(fields)}; a dictionary is needed.")
        return fields


def _field(fields: Fields, *keys: str) -> Any:
    """A value in nested dictionaries."""
    value: object = fields
    for key in keys:
        if not isinstance(value, dict) or key not in value:
            raise MemberError(f"it lacks {'.'.join(keys)}.")
        value = value[key]
    return value


def _text(fields: Fields, key: str) -> str:
    value = _field(fields, key)
    if not isinstance(value, str):
        raise MemberError(f"{key} is {describe_kind(value)}; a text is needed.")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise MemberError(f"{key} is no valid text.") from None
    return value


def _whole_number(fields: Fields, key: str, largest: int) -> int:
    value = as_plain(_field(fields, key))
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= largest:
        raise MemberError(
            f"{key} is {describe_kind(value)}; a whole number within 0 … {largest:,} is needed."
        )
    return value


def _images(value: object, *leading: int, channels: int = 0) -> np.ndarray:
    """A writable copy of one or more images."""
    array, shape = as_array(value), (*leading, *((channels,) if channels else ()), *IMAGE_SHAPE)
    if array.shape != shape or array.dtype != np.uint8:
        raise MemberError(f"it has images of shape {array.shape}, {array.dtype}; needed are {shape}, uint8.")
    return array.copy()


def _actions(fields: Fields) -> tuple[Action, ...]:
    """The actions; of positions with a height, x and y."""
    columns = {}
    for key, length in ACTION_SHAPES.items():
        array = as_array(_field(fields, key))
        allowed = (2, 3) if length == 2 else (4,)
        if array.ndim != 2 or array.shape[1] not in allowed or array.dtype.kind != "f":
            raise MemberError(
                f"{key} has shape {array.shape} and type {array.dtype}; it must be (T, {length})."
            )
        columns[key] = _check_rows(key, array[:, :length].astype(np.float32))
    lengths = {key: len(rows) for key, rows in columns.items()}
    if len(set(lengths.values())) > 1 or not columns["pose0_position"]:
        raise MemberError(f"its arrays have {lengths} rows; they must be equally many, and at least one.")
    return tuple(
        Action(**{key: tuple(rows[step]) for key, rows in columns.items()})
        for step in range(len(columns["pose0_position"]))
    )


def _check_rows(key: str, rows: np.ndarray) -> list[list[float]]:
    low, high = (WORKSPACE_LOW, WORKSPACE_HIGH) if rows.shape[1] == 2 else (-1.0, 1.0)
    least, most = np.array(low, np.float32), np.array(high, np.float32)
    outside = ~((rows >= least) & (rows <= most)).all(axis=1)  # also what is no number
    if outside.any():
        step = int(outside.argmax())
        raise MemberError(f"{key} of step {step} is {rows[step].tolist()}; allowed are {low} … {high}.")
    return rows.tolist()


def _segmentation(fields: Fields, num_images: int) -> dict[str, np.ndarray]:
    return {view: _images(_field(fields, "segm", view), num_images) for view in VIEWS}


def _end_effector(trajectory: Fields, observations: Fields, num_images: int) -> EndEffector:
    name = _field(trajectory, "end_effector_type")
    if name not in END_EFFECTORS:
        raise MemberError(
            f"end_effector_type is {describe_kind(name)}; allowed are {', '.join(END_EFFECTORS)}."
        )
    shown = as_array(_field(observations, "ee"))
    if shown.shape != (num_images,) or (shown != END_EFFECTORS.index(name)).any():
        raise MemberError(f"the tool is {name!r}, but obs.pkl shows another or in another number of steps.")
    return name


def _objects(trajectory: Fields) -> tuple[ObjectRecord, ...]:
    entries = _field(trajectory, "obj_id_to_info")
    if not isinstance(entries, dict) or not entries:
        raise MemberError("obj_id_to_info lists no objects.")
    return tuple(_object(object_id, entry, "texture_name") for object_id, entry in entries.items())


def _object(object_id: object, entry: Fields, texture_key: str) -> ObjectRecord:
    """A record; textures that the catalogue does not know stay, since nothing but their name is ever used."""
    number = _whole_number({"obj_id": object_id}, "obj_id", 255)
    return ObjectRecord(number, check_object(_field(entry, "obj_name")), _text(entry, texture_key))


def _prompt(trajectory: Fields) -> RenderedPrompt:
    """The prompt, its images in the order in which the text names them."""
    text, assets = _text(trajectory, "prompt"), _field(trajectory, "prompt_assets")
    if not isinstance(assets, dict) or not all(isinstance(name, str) for name in assets):
        raise MemberError("prompt_assets names no images.")
    images = {name: _prompt_image(name, asset) for name, asset in assets.items()}
    try:
        RenderedPrompt(text, images).sequence()
    except PromptError as error:
        raise MemberError(str(error)) from None
    return RenderedPrompt(
        text, {name: images[name] for name in sorted(images, key=lambda n: text.index(f"{{{n}}}"))}
    )


def _prompt_image(name: str, asset: Fields) -> PromptImage:
    kind = _field(asset, "placeholder_type")
    if kind not in _KINDS:
        raise MemberError(
            f"placeholder_type of {name} is {describe_kind(kind)}; allowed are {', '.join(_KINDS)}."
        )
    entries = _field(asset, "segm", "obj_info")
    objects: Sequence[Any] = entries if isinstance(entries, list) else [entries]
    return PromptImage(
        name=name,
        kind=kind,
        rgb={view: _images(_field(asset, "rgb", view), channels=3) for view in VIEWS},
        segm={view: _images(_field(asset, "segm", view)) for view in VIEWS},
        objects=tuple(_object(_field(entry, "obj_id"), entry, "obj_color") for entry in objects),
    )


def _check_summary(trajectory: Fields, num_steps: int) -> None:
    """Compare what the episode says of itself with what it holds."""
    steps, success = as_plain(_field(trajectory, "steps")), as_plain(_field(trajectory, "success"))
    if steps != num_steps:
        raise MemberError(f"steps is {describe_kind(steps)}, but action.pkl has {num_steps} actions.")
    if success is not True:
        raise MemberError(f"success is {describe_kind(success)}; only solved episodes are demonstrations.")
    difficulty = trajectory.get("difficulty", "easy")
    if difficulty != "easy":
        raise MemberError(f"difficulty is {describe_kind(difficulty)}; the published episodes are easy.")


def _frames(files: Mapping[str, bytes], folder: str, num_images: int) -> np.ndarray:
    """The images of one view in the order of their numbers, shape (T + 1, 3, 128, 256), uint8."""
    numbered = {
        frame_number(name): content for name, content in files.items() if name.startswith(f"{folder}/")
    }
    if set(numbered) != set(range(num_images)):
        missing = [n for n in range(num_images) if n not in numbered]
        detail = f"{missing[0]}.jpg is missing" if missing else f"{num_images} are needed"
        raise MemberError(f"{folder} has {len(numbered)} images for {num_images - 1} actions; {detail}.")
    stacked = np.empty((num_images, *IMAGE_SHAPE, 3), np.uint8)
    for number in range(num_images):
        stacked[number] = _decode(numbered[number], f"{folder}/{number}.jpg")
    return channels_first(stacked)


def _decode(content: bytes, name: str) -> np.ndarray:
    height, width = IMAGE_SHAPE
    try:
        with Image.open(io.BytesIO(content), formats=("JPEG",)) as image:
            # The size is known from the head, so nothing larger is ever decoded.
            if image.size != (width, height) or image.mode != "RGB":
                raise MemberError(
                    f"{name} is {image.size[0]} × {image.size[1]}, {image.mode}; not {width} × {height}."
                )
            return np.asarray(image)
    except (
        OSError,
        ValueError,
        SyntaxError,
        Image.DecompressionBombError,
        Image.DecompressionBombWarning,
    ) as error:
        if isinstance(error, MemberError):
            raise
        raise MemberError(f"{name} is no whole JPEG image.") from None


def check_object(name: object) -> str:
    """Return an object's display name, which is the same here and there.

    Raises:
        MemberError: The catalogue has no such object.
    """
    if not isinstance(name, str) or name not in OBJECTS:
        shown = name[:60] if isinstance(name, str) else type(name).__name__
        raise MemberError(unknown_name("object", shown, OBJECTS, "`openvima assets info` lists them."))
    return name
