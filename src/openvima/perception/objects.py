"""From images to objects: the boxes, crops and grasp points that policies see instead of pixels.

Boxes and crops are exactly those of the published VIMA evaluation script, so that published weights see what
they were trained on: the box is one pixel short in height and width and its centre truncated, crops keep the
pixels around the object, and the resize is OpenCV's area interpolation bit for bit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from openvima.errors import PolicyError, ShapeError, echo
from openvima.perception.kernels import (
    CROP_SIZE,
    halve_frame,
    most_interior_pixel,
    object_extents,
    resize_square,
)
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.scene import BACKGROUND_ID, END_EFFECTORS, FIRST_OBJECT_ID, PromptImage

MAX_OBJECTS = 64  # of an image; the hardest scenes of the benchmark have 9
MIN_PIXELS = 2  # an object that shows fewer pixels in a view counts as hidden there
FRONT, TOP = VIEWS.index("front"), VIEWS.index("top")
_NUM_IDS = 256  # of a segmentation
_BY_VIEW = ("crops", "boxes", "masks", "grasps")  # of objects, with an axis for the view


@dataclass(frozen=True, slots=True, eq=False)
class ObjectViews:
    """The objects of one moment; slot k is the same object in both views. View axis: front, then top.

    Args:
        ids: Segmentation values, shape (N,), int64.
        crops: Images inside the boxes, shape (2, N, 3, 32, 32), uint8; black where hidden.
        boxes: Centre x, centre y, height, width in pixels, shape (2, N, 4), int64; zero where hidden.
        masks: Whether the object shows at least two pixels in the view, shape (2, N), bool.
        grasps: Column and row of the most interior visible pixel, shape (2, N, 2), int64; zero where hidden.
    """

    ids: np.ndarray
    crops: np.ndarray
    boxes: np.ndarray
    masks: np.ndarray
    grasps: np.ndarray

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, slots: np.ndarray) -> "ObjectViews":
        """Return the objects of the given slots (indices or booleans), in that order."""
        return ObjectViews(self.ids[slots], *(getattr(self, name)[:, slots] for name in _BY_VIEW))

    @staticmethod
    def concatenate(images: Sequence["ObjectViews"]) -> "ObjectViews":
        """Put the objects of several images into one record, image after image."""
        if not images:
            return make_hidden_objects()
        by_view = (np.concatenate([getattr(each, name) for each in images], axis=1) for name in _BY_VIEW)
        return ObjectViews(np.concatenate([each.ids for each in images]), *by_view)

    def visible(self) -> np.ndarray:
        """Whether each object shows in some view, shape (N,), bool."""
        return np.asarray(self.masks.any(axis=0))

    def left_to_right(self) -> "ObjectViews":
        """Return the visible objects as they lie on the table, the leftmost in the images first.

        Of objects in one place the one with the smaller boxes comes first, such as what lies in a container.
        """
        seen = self.select(self.visible())
        points, sizes = seen.positions(), seen.boxes[..., 2:].sum(axis=(0, 2))
        return seen.select(np.lexsort((sizes, points[:, 0], points[:, 1])))

    def positions(self) -> np.ndarray:
        """Points on the table under the centres of the boxes, shape (N, 2), float64, metres.

        The top view gives them; the front view stands in where an object is hidden from above.
        """
        return self._on_table(self.boxes[..., :2])

    def grasp_points(self) -> np.ndarray:
        """Points on the table under the most interior pixels, shape (N, 2), float64, metres."""
        return self._on_table(self.grasps)

    def _on_table(self, pixels: np.ndarray) -> np.ndarray:
        front, top = (unproject(own, CAMERAS[view]) for own, view in zip(pixels, VIEWS, strict=True))
        return np.where(self.masks[TOP][:, None], top, front)


class ObjectExtractor(Protocol):
    """Finds the objects in images: by their segmentation, or by a detector that knows pixels only."""

    def in_observation(self, observation: Mapping) -> ObjectViews:
        """Find the objects of an observation (`rgb`, `segm`, `ee`), from left to right."""
        ...

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        """Find the objects that a prompt's image shows."""
        ...


@runtime_checkable
class AheadExtractor(ObjectExtractor, Protocol):
    """Takes less time for several images together, and keeps their objects until it is asked for them."""

    def extract_ahead(self, observations: Sequence[Mapping], images: Sequence[PromptImage]) -> None:
        """Find the objects of observations and prompt images that will be asked for."""
        ...


def make_hidden_objects(count: int = 0) -> ObjectViews:
    """Return so many hidden objects."""
    views = len(VIEWS)
    return ObjectViews(
        np.full(count, -1, np.int64),
        np.zeros((views, count, 3, CROP_SIZE, CROP_SIZE), np.uint8),
        np.zeros((views, count, 4), np.int64),
        np.zeros((views, count), np.bool_),
        np.zeros((views, count, 2), np.int64),
    )


def whole_frames(rgb: Mapping[str, np.ndarray]) -> ObjectViews:
    """Take both frames as one object that fills them, for the policies that see no objects.

    The frames are halved in both directions by averages over 2 × 2 pixels, rounded half up.

    Args:
        rgb: View name to image, shape (3, 128, 256), uint8.

    Returns:
        One slot, its crops of shape (2, 1, 3, 64, 128).

    Raises:
        PolicyError: A view is missing.
        ShapeError: An image has another shape or dtype.
    """
    frames = list(camera_frames(rgb, "rgb").values())
    height, width = frames[0].shape[1:]
    halves = np.empty((len(VIEWS), 1, 3, height // 2, width // 2), np.uint8)
    for view, frame in enumerate(frames):
        halve_frame(frame, halves[view, 0])
    objects, centre = replace(make_hidden_objects(1), crops=halves), ((width - 1) // 2, (height - 1) // 2)
    objects.boxes[:], objects.masks[:], objects.grasps[:] = (*centre, height - 1, width - 1), True, centre
    return objects


def extract_objects(
    rgb: Mapping[str, np.ndarray], segm: Mapping[str, np.ndarray], object_ids: Sequence[int] | np.ndarray
) -> ObjectViews:
    """Cut the given objects out of the images of both views.

    Args:
        rgb: View name to image, shape (3, 128, 256), uint8.
        segm: View name to object ids, shape (128, 256), uint8.
        object_ids: Which segmentation values are objects, in the order of the slots.

    Returns:
        One slot for each id, in both views, hidden or not.

    Raises:
        PolicyError: A view is missing, an id is not one of 0 to 255, or there are more than `MAX_OBJECTS`.
        ShapeError: An image has another shape or dtype.
    """
    ids = np.asarray(object_ids, dtype=np.int64)
    if not np.isin(ids, np.arange(_NUM_IDS)).all():
        raise PolicyError(
            f"object ids are {echo(str(ids.tolist()))}; they must lie in 0 … 255, as segmentations do."
        )
    return _cut_out(_measure(camera_frames(rgb, "rgb"), segm), ids)


def observe(observation: Mapping) -> ObjectViews:
    """Find the objects of an observation by its segmentation.

    Objects are all segmentation values from the end effector's first object id up to 254. Their order
    is that of the images, not of the ids, which could give away how the task laid the table.

    Args:
        observation: `rgb` and `segm`, each view name to array of 128 × 256 pixels, and `ee`, the index of the
            end effector.

    Returns:
        The objects that show at least two pixels in some view.

    Raises:
        PolicyError: A part or a view is missing, there is no such end effector, or there are more than
            `MAX_OBJECTS` objects.
        ShapeError: An image has another shape or dtype.
    """
    first = FIRST_OBJECT_ID[END_EFFECTORS[end_effector_of(observation)]]
    views = _measure(observation_frames(observation), part_of(observation, "segm"))
    shown = np.max([view.num_pixels for view in views], axis=0) >= MIN_PIXELS
    return _cut_out(views, first + np.flatnonzero(shown[first:BACKGROUND_ID])).left_to_right()


def observe_prompt_image(image: PromptImage) -> ObjectViews:
    """Find the objects that a prompt's image shows, in the order of its records, hidden ones left out.

    Raises:
        PolicyError: A view is missing.
        ShapeError: An image has another shape or dtype.
    """
    ids = [record.object_id for record in image.objects]
    objects = extract_objects(prompt_image_frames(image), image.segm, ids)
    return objects.select(objects.visible())


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Finds the objects by the simulator's segmentation, as the published policies do."""

    in_observation = staticmethod(observe)
    in_prompt_image = staticmethod(observe_prompt_image)


GROUND_TRUTH = GroundTruth()


def part_of(observation: Mapping, name: str) -> Mapping:
    """Return `rgb` or another part of an observation.

    Raises:
        PolicyError: It is not there.
    """
    if name not in observation:
        raise PolicyError(
            f"the observation holds {sorted(observation)} but no {name!r}; it must hold 'rgb' and 'ee', and "
            "'segm' where objects are found by segmentation."
        )
    return observation[name]


def end_effector_of(observation: Mapping) -> int:
    """Return the index of an observation's end effector.

    Raises:
        PolicyError: It is missing or none of those that exist.
    """
    index = np.asarray(part_of(observation, "ee"))
    if index.shape or index.dtype.kind not in "iu" or not 0 <= index < len(END_EFFECTORS):
        names = " or ".join(f"{number} ({name})" for number, name in enumerate(END_EFFECTORS))
        raise PolicyError(f"ee is {observation['ee']!r}; it must be {names}.")
    return int(index)


def observation_frames(observation: Mapping) -> dict[str, np.ndarray]:
    """Return the frames of an observation; see `camera_frames`."""
    return camera_frames(part_of(observation, "rgb"), "the observation's rgb")


def prompt_image_frames(image: PromptImage) -> dict[str, np.ndarray]:
    """Return the frames of a prompt image; see `camera_frames`."""
    return camera_frames(image.rgb, f"the rgb of prompt image {image.name!r}")


def camera_frames(
    images: Mapping[str, np.ndarray], what: str, *, channels: tuple[int, ...] = (3,)
) -> dict[str, np.ndarray]:
    """Return the images of both cameras, front before top.

    Args:
        images: View name to image, shape (3, 128, 256), uint8; that of a segmentation has no channels.
        what: How messages call them.
        channels: (3,), or () for segmentations.

    Raises:
        PolicyError: A view is missing.
        ShapeError: An image has another shape or dtype.
    """
    missing = [view for view in VIEWS if not isinstance(images, Mapping) or view not in images]
    if missing:
        raise PolicyError(
            f"{what} lacks the view {' and '.join(missing)}; it must hold an image of {' and '.join(VIEWS)}."
        )
    frames: dict[str, np.ndarray] = {}
    for view in VIEWS:
        frames[view] = frame = np.ascontiguousarray(images[view])
        expected = (*channels, CAMERAS[view].height, CAMERAS[view].width)
        if frame.dtype != np.uint8 or frame.shape != expected:
            name = "rgb" if channels else "segm"
            raise ShapeError(f"{name} {view!r} is {frame.dtype} {frame.shape}; it must be uint8 {expected}.")
    return frames


def crop_box(rgb: np.ndarray, extent: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Cut an arbitrary rectangle out of an image, as if an object filled it.

    Args:
        rgb: Image, shape (3, H, W), uint8.
        extent: First and last column, first and last row, inclusive.

    Returns:
        The crop, shape (3, 32, 32), uint8, and the box, shape (4,), int64.
    """
    xmin, xmax, ymin, ymax = extent
    width, height = xmax - xmin + 1, ymax - ymin + 1
    size = max(width, height)
    left, top = (size - width) // 2, (size - height) // 2
    square = np.zeros((3, size, size), np.uint8)
    square[:, top : top + height, left : left + width] = rgb[:, ymin : ymax + 1, xmin : xmax + 1]
    scratch = np.empty((CROP_SIZE, size))
    crop = np.empty((3, CROP_SIZE, CROP_SIZE), np.uint8)
    resize_square(square, size, scratch, crop)
    return crop, np.array([(xmin + xmax) // 2, (ymin + ymax) // 2, ymax - ymin, xmax - xmin])


class _Measured(NamedTuple):
    """One view and what its segmentation says: extents (256, 4) and numbers of pixels (256,) of all ids."""

    rgb: np.ndarray
    segm: np.ndarray
    extents: np.ndarray
    num_pixels: np.ndarray


def _measure(frames: Mapping[str, np.ndarray], segm: Mapping[str, np.ndarray]) -> list[_Measured]:
    views = []
    for view, ids in camera_frames(segm, "segm", channels=()).items():
        extents, num_pixels = np.empty((_NUM_IDS, 4), np.int64), np.empty(_NUM_IDS, np.int64)
        object_extents(ids, extents, num_pixels)
        views.append(_Measured(frames[view], ids, extents, num_pixels))
    return views


def _cut_out(views: Sequence[_Measured], ids: np.ndarray) -> ObjectViews:
    if len(ids) > MAX_OBJECTS:
        raise PolicyError(f"an image has {len(ids)} objects; at most {MAX_OBJECTS} are allowed.")
    objects = replace(make_hidden_objects(len(ids)), ids=ids)
    for v, view in enumerate(views):
        objects.masks[v] = view.num_pixels[ids] >= MIN_PIXELS
        for slot in np.flatnonzero(objects.masks[v]):
            left, right, upper, lower = extent = view.extents[ids[slot]].tolist()
            objects.crops[v, slot], objects.boxes[v, slot] = crop_box(view.rgb, extent)
            mask = view.segm[upper : lower + 1, left : right + 1] == ids[slot]
            objects.grasps[v, slot] = np.add(interior_pixel(mask), (left, upper))
    return objects


def interior_pixel(mask: np.ndarray) -> np.ndarray:
    """Find the pixel of an object that is farthest from its outline.

    Args:
        mask: Where the object is in a window, shape (H, W), bool; somewhere it is.

    Returns:
        Column and row in the window, shape (2,), int64.
    """
    height, width = mask.shape
    distance = np.empty((height + 2, width + 2), np.int32)
    return np.array(most_interior_pixel(np.ascontiguousarray(mask), distance))
