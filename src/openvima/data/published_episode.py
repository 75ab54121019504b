"""One published episode: unpickling its files without running their code, and what it demonstrates.

A pickle is a program that may call any function. `read_pickle` runs it with a `pickle.Unpickler` that knows
only the names in published files, and gives none what it names: arrays and numbers are decoded from their
bytes, and everything else becomes an object that takes what it is given and does nothing.
"""

import contextlib
import io
import pickle
import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from PIL import Image

from openvima.catalog import OBJECTS
from openvima.data.encoding import decode_actions
from openvima.data.published_sources import FRAME_FOLDERS, PICKLES
from openvima.data.records import Demonstration
from openvima.data.schema import IMAGE_SHAPE, UNKNOWN_ID, VIEWS
from openvima.errors import DatasetError, unknown_name
from openvima.imports import versions_of
from openvima.render import channels_first
from openvima.render.camera import TOP, project
from openvima.scene import (
    ACTION_SHAPES,
    END_EFFECTORS,
    Action,
    ObjectRecord,
    Outcome,
    PromptImage,
    RenderedPrompt,
)
from openvima.scene.prompt import PLACEHOLDER
from openvima.scene.scene import WORKSPACE_HIGH, WORKSPACE_LOW
from openvima.tasks import task_spec
from openvima.tasks.sampling import MAX_SEED

_MAX_TEXT = 200  # characters of a name or reason that a message quotes
# What damaged bytes, or those of another form, make Python raise.
_DAMAGE_ERRORS = (
    *(pickle.UnpicklingError, LookupError, TypeError, ValueError, AttributeError, EOFError),
    *(ArithmeticError, MemoryError),
)
_DTYPE = re.compile(r"[<>|=]?[buif][1248]")
_INERT = re.compile(
    r"(vimasim|vima_bench|omegaconf|typing)\..*|collections\.defaultdict|functools\.partial|numpy\.ndarray"
    r"|builtins\.(dict|list|int)"
)


class Inert:
    """Stand-in for whatever a pickle names and nothing reads."""

    def __init__(self, *args: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        """Ignore the state."""

    def __setitem__(self, key: object, value: object) -> None:
        """Ignore the items of a mapping."""


class _Dtype(Inert):
    """A type of numbers; others are refused."""

    def __init__(self, spec: object, *_: object) -> None:
        if not isinstance(spec, str) or not _DTYPE.fullmatch(spec):
            raise DatasetError(f"it has an array of type {_describe(spec)}; only numbers are read.")
        self.dtype = np.dtype(spec)

    def __setstate__(self, state: Any) -> None:
        """Take the order of bytes."""
        if state[1] == ">":
            self.dtype = self.dtype.newbyteorder(">")

    def numbers(self, content: bytes | bytearray) -> np.ndarray:
        """View bytes as numbers, read-only: as many as there are, whatever a file claims."""
        return np.frombuffer(memoryview(content).toreadonly(), self.dtype)


class _Array(Inert):
    """An array, before protocol 5."""

    def __setstate__(self, state: Any) -> None:
        """Decode it."""
        _, shape, dtype, by_columns, content = state
        self.array = dtype.numbers(content).reshape(shape, order="F" if by_columns else "C")


def _decode_buffer(content: bytes, dtype: _Dtype, shape: Any, order: Any, *axes: Any) -> np.ndarray:
    """Decode an array of protocol 5."""
    array = dtype.numbers(content).reshape(shape, order="C" if order == "K" else order)
    return array.transpose(*axes) if order == "K" else array


def _decode_scalar(dtype: _Dtype, content: bytes) -> Any:
    return dtype.numbers(content).reshape(()).item()


_DECODERS: dict[str, Any] = {
    "multiarray._reconstruct": _Array,
    "numeric._frombuffer": _decode_buffer,
    "multiarray.scalar": _decode_scalar,
    "dtype": _Dtype,
}


def read_pickle(content: bytes) -> Any:
    """Return the data in a pickle: plain values, lists, tuples, dictionaries, `as_array`'s, and `Inert`.

    Args:
        content: The file.

    Raises:
        DatasetError: It is damaged, or more than data.
    """
    try:
        return _Unpickler(io.BytesIO(content)).load()
    except DatasetError:
        raise
    except _DAMAGE_ERRORS as error:
        reason = str(error)[:_MAX_TEXT] or type(error).__name__
        raise DatasetError(f"it is truncated or no pickle of data ({reason}).") from None


class _Unpickler(pickle.Unpickler):
    """Finds stand-ins only."""

    def find_class(self, module: str, name: str) -> Any:
        """Return what stands for a name."""
        dotted = f"{module}.{name}"
        decoder = _DECODERS.get(re.sub(r"^numpy\.(_?core\.)?", "", dotted))
        if decoder is not None and dotted.startswith("numpy."):
            return decoder
        if _INERT.fullmatch(dotted):
            return Inert
        raise DatasetError(f"it names {dotted[:_MAX_TEXT]}, which no published file needs; nothing was run.")


def as_array(value: object) -> np.ndarray:
    """Return an array that `read_pickle` decoded, read-only.

    Raises:
        DatasetError: The value is none.
    """
    array = getattr(value, "array", value)
    if not isinstance(array, np.ndarray):
        raise DatasetError(f"it has {_describe(value)} where an array should be.")
    return array


def _describe(value: object) -> str:
    """Describe a value without visiting nested values, which may be endless."""
    plain = value is None or isinstance(value, str | int | float)
    return f"{value!r:.60}" if plain else f"a {type(value).__name__}"


# The original oracle chooses from a finer image, so at an edge its pixel can be a neighbour here.
_REACH_PX = range(-2, 3)
_AROUND = np.array(sorted(product(_REACH_PX, _REACH_PX), key=lambda at: (at[0] ** 2 + at[1] ** 2, at)))


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
    picks = []
    for image, (column, row) in zip(segm, np.rint(project(points, TOP)).astype(int), strict=False):
        places = np.add(_AROUND, (row, column))
        places = places[((places >= 0) & (places < image.shape)).all(axis=1)]
        seen = image[tuple(places.T)]
        found = seen[np.isin(seen, list(object_ids))]
        picks.append(int(found[0]) if len(found) else UNKNOWN_ID)
    return tuple(picks)


DOMAIN, LEVEL, ASSETS = "published", "train", "original"

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
        DatasetError: A file is missing, damaged or of another form; the message begins with its name.
    """
    contents = []
    for name in PICKLES:
        with _naming(name):
            contents.append(read_pickle(files[name]))
    observations, actions, trajectory = contents
    with _naming("action.pkl"):
        steps = _actions(actions)
    num_images = len(steps) + 1
    with _naming("obs.pkl"):
        segm = {view: _images(observations["segm"][view], num_images) for view in VIEWS}
        shown = as_array(observations["ee"])
    with _naming("trajectory.pkl"):
        _check_summary(trajectory, len(steps))
        end_effector, objects = trajectory["end_effector_type"], trajectory["obj_id_to_info"]
        if shown.shape != (num_images,) or (shown != END_EFFECTORS.index(end_effector)).any():
            raise DatasetError(f"the tool is {end_effector!r}, but obs.pkl shows another.")
        objects = tuple(_object(object_id, entry, "texture_name") for object_id, entry in objects.items())
        prompt, seed = _prompt(trajectory), _whole_number(trajectory["seed"], MAX_SEED)
    return Demonstration(
        task=task,
        level=LEVEL,
        domain=DOMAIN,
        seed=seed,
        num_redraws=0,
        max_steps=task_spec(task).max_steps,
        prompt=prompt,
        rgb={view: _frames(files, name, num_images) for view, name in zip(VIEWS, FRAME_FOLDERS, strict=True)},
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
    """Name the file in which something is damaged, or of another form."""
    try:
        yield
    except DatasetError as error:
        raise DatasetError(f"{name}: {error}") from None
    except _DAMAGE_ERRORS as error:
        reason = f"{type(error).__name__}: {error}"
        raise DatasetError(f"{name} is missing or of another form ({reason[:_MAX_TEXT]}).") from None


def _whole_number(value: object, largest: int) -> int:
    if type(value) is not int or not 0 <= value <= largest:
        raise DatasetError(f"a number is {_describe(value)}; a whole one within 0 … {largest:,} is needed.")
    return value


def _images(value: object, *leading: int) -> np.ndarray:
    """A writable copy of one or more images."""
    array, shape = as_array(value), (*leading, *IMAGE_SHAPE)
    if array.shape != shape or array.dtype != np.uint8:
        raise DatasetError(f"it has images of shape {array.shape}, {array.dtype}; needed are {shape}, uint8.")
    return array.copy()


def _actions(fields: Fields) -> tuple[Action, ...]:
    """The actions; of positions with a height, x and y."""
    columns = {}
    for key, length in ACTION_SHAPES.items():
        rows = as_array(fields[key])[:, :length].astype(np.float32)
        bounds = (WORKSPACE_LOW, WORKSPACE_HIGH) if length == 2 else (-1.0, 1.0)
        low, high = np.array(bounds, np.float32)
        inside = (rows >= low) & (rows <= high)  # what is no number is not
        if rows.shape[1:] != (length,) or not inside.all():
            raise DatasetError(
                f"{key} is {rows.tolist()!s:.80}; it must be of shape (T, {length}), within {bounds[0]} … "
                f"{bounds[1]}."
            )
        columns[key] = rows
    if steps := decode_actions(columns):
        return steps
    raise DatasetError("it holds no actions.")


def _object(object_id: object, entry: Fields, texture_key: str) -> ObjectRecord:
    """A record; textures that the catalogue does not know stay, since nothing but their name is ever used."""
    name, texture = entry["obj_name"], entry[texture_key]
    _ = name.encode(), texture.encode()  # which fails for all but valid texts
    if name not in OBJECTS:
        raise DatasetError(unknown_name("object", name[:60], OBJECTS, "`openvima assets info` lists them."))
    return ObjectRecord(_whole_number(object_id, 255), name, texture)


def _prompt(trajectory: Fields) -> RenderedPrompt:
    """The prompt, its images in the order in which the text names them."""
    text, assets = trajectory["prompt"], trajectory["prompt_assets"]
    text.encode()
    names = list(dict.fromkeys(PLACEHOLDER.findall(text)))
    if set(names) != assets.keys():
        raise DatasetError(f"the prompt names images {', '.join(names)[:_MAX_TEXT]}; there are others.")
    return RenderedPrompt(text, {name: _prompt_image(name, assets[name]) for name in names})


def _prompt_image(name: str, asset: Fields) -> PromptImage:
    kind = asset["placeholder_type"]
    if kind not in ("object", "scene"):
        raise DatasetError(f"{name} is an image of {_describe(kind)}, no object or scene.")
    entries = asset["segm"]["obj_info"]
    return PromptImage(
        name=name,
        kind=kind,
        rgb={view: _images(asset["rgb"][view], 3) for view in VIEWS},
        segm={view: _images(asset["segm"][view]) for view in VIEWS},
        objects=tuple(
            _object(entry["obj_id"], entry, "obj_color")
            for entry in (entries if isinstance(entries, list) else [entries])
        ),
    )


def _check_summary(trajectory: Fields, num_steps: int) -> None:
    """Compare what the episode says of itself with what it holds."""
    expected = {"steps": num_steps, "success": True, "difficulty": "easy"}
    for name, value in expected.items():
        if (found := trajectory.get(name, "easy")) != value:
            raise DatasetError(f"{name} is {_describe(found)}; {value!r} is needed.")


def _frames(files: Mapping[str, bytes], folder: str, num_images: int) -> np.ndarray:
    """The images of one view in the order of their numbers, shape (T + 1, 3, 128, 256), uint8."""
    names = [f"{folder}/{number}.jpg" for number in range(num_images)]
    found = [name for name in files if name.startswith(f"{folder}/")]
    if set(found) != set(names):
        raise DatasetError(
            f"{folder} has {len(found)} images for {num_images - 1} actions, or misnames some."
        )
    return channels_first(np.stack([_decode(files[name], name) for name in names]))


def _decode(content: bytes, name: str) -> np.ndarray:
    height, width = IMAGE_SHAPE
    try:
        with Image.open(io.BytesIO(content), formats=("JPEG",)) as image:
            # The size is known from the head, so nothing larger is ever decoded.
            if image.size != (width, height) or image.mode != "RGB":
                raise DatasetError(f"{name} is {image.size}, {image.mode}; not {width} × {height}, RGB.")
            return np.asarray(image)
    except DatasetError:
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        raise DatasetError(f"{name} is no whole JPEG image.") from None
