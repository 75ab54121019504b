"""One published episode as a demonstration."""

import contextlib
import io
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from openvima.data.published.layout import PICKLES, frame_number
from openvima.data.published.names import checked_object
from openvima.data.published.picks import picked_ids
from openvima.data.published.unpickling import as_array, as_plain, kind_of, read_pickle
from openvima.data.records import Demonstration, versions_of
from openvima.data.schema import IMAGE_SHAPE, UNKNOWN_ID, VIEWS
from openvima.errors import MemberError, PromptError
from openvima.render import channels_first
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
from openvima.tasks.seeding import MAX_SEED

DOMAIN, LEVEL, ASSETS = "published", "train", "original"
_KINDS = ("object", "scene")

Fields = dict[str, Any]  # Any: what a pickle holds


def demonstration_of(files: Mapping[str, bytes], *, task: str, folder: str) -> Demonstration:
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
    observations, actions, trajectory = (_unpickled(files, name) for name in PICKLES)
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
        pick_ids=picked_ids(segm["top"], steps, [record.object_id for record in objects]),
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


def _unpickled(files: Mapping[str, bytes], name: str) -> Fields:
    if name not in files:
        raise MemberError(f"{name} is missing.")
    with _naming(name):
        fields = read_pickle(files[name])
        if not isinstance(fields, dict):
            raise MemberError(f"it holds {kind_of(fields)}; a dictionary is needed.")
        return fields


def _field(fields: Fields, *keys: str) -> Any:  # Any: what a pickle holds
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
        raise MemberError(f"{key} is {kind_of(value)}; a text is needed.")
    try:
        value.encode()
    except UnicodeEncodeError:
        raise MemberError(f"{key} is no valid text.") from None
    return value


def _whole_number(fields: Fields, key: str, largest: int) -> int:
    value = as_plain(_field(fields, key))
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= largest:
        raise MemberError(f"{key} is {kind_of(value)}; a whole number within 0 … {largest:,} is needed.")
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
        columns[key] = _checked_rows(key, array[:, :length].astype(np.float32))
    lengths = {key: len(rows) for key, rows in columns.items()}
    if len(set(lengths.values())) > 1 or not columns["pose0_position"]:
        raise MemberError(f"its arrays have {lengths} rows; they must be equally many, and at least one.")
    return tuple(
        Action(**{key: tuple(rows[step]) for key, rows in columns.items()})
        for step in range(len(columns["pose0_position"]))
    )


def _checked_rows(key: str, rows: np.ndarray) -> list[list[float]]:
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
        raise MemberError(f"end_effector_type is {kind_of(name)}; allowed are {', '.join(END_EFFECTORS)}.")
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
    return ObjectRecord(number, checked_object(_field(entry, "obj_name")), _text(entry, texture_key))


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
        raise MemberError(f"placeholder_type of {name} is {kind_of(kind)}; allowed are {', '.join(_KINDS)}.")
    entries = _field(asset, "segm", "obj_info")
    shown: Sequence[Any] = entries if isinstance(entries, list) else [entries]
    return PromptImage(
        name=name,
        kind=kind,
        rgb={view: _images(_field(asset, "rgb", view), channels=3) for view in VIEWS},
        segm={view: _images(_field(asset, "segm", view)) for view in VIEWS},
        objects=tuple(_object(_field(entry, "obj_id"), entry, "obj_color") for entry in shown),
    )


def _check_summary(trajectory: Fields, num_steps: int) -> None:
    """Compare what the episode says of itself with what it holds."""
    steps, success = as_plain(_field(trajectory, "steps")), as_plain(_field(trajectory, "success"))
    if steps != num_steps:
        raise MemberError(f"steps is {kind_of(steps)}, but action.pkl has {num_steps} actions.")
    if success is not True:
        raise MemberError(f"success is {kind_of(success)}; only solved episodes are demonstrations.")
    difficulty = trajectory.get("difficulty", "easy")
    if difficulty != "easy":
        raise MemberError(f"difficulty is {kind_of(difficulty)}; the published episodes are easy.")


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
        stacked[number] = _decoded(numbered[number], f"{folder}/{number}.jpg")
    return channels_first(stacked)


def _decoded(content: bytes, name: str) -> np.ndarray:
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
