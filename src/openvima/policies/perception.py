"""From images to objects: the boxes, crops and grasp points that policies see instead of pixels.

Boxes and crops are exactly those of the published VIMA evaluation script, so that published weights see what
they were trained on: the box is one pixel short in height and width and its centre truncated, crops keep the
pixels around the object, and the resize is OpenCV's area interpolation bit for bit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from openvima.errors import ShapeError
from openvima.policies.kernels import (
    CROP_SIZE,
    most_interior_pixel,
    object_extents,
    resize_square,
    square_crop,
)
from openvima.render.camera import CAMERAS, VIEWS, unproject
from openvima.scene import BACKGROUND_ID, END_EFFECTORS, FIRST_OBJECT_ID, PromptImage

MIN_PIXELS = 2  # an object that shows fewer pixels in a view counts as hidden there
FRONT, TOP = VIEWS.index("front"), VIEWS.index("top")


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
        return ObjectViews(
            self.ids[slots],
            self.crops[:, slots],
            self.boxes[:, slots],
            self.masks[:, slots],
            self.grasps[:, slots],
        )

    def compacted(self) -> "ObjectViews":
        """Return visible objects first in each view, padding at its end, as published policies expect.

        Slots of the two views then need not show the same object, and `ids` name nothing any more.
        """
        order = np.argsort(~self.masks, axis=1, kind="stable")
        rows = np.arange(len(VIEWS))[:, None]
        return ObjectViews(
            np.full_like(self.ids, -1),
            self.crops[rows, order],
            self.boxes[rows, order],
            self.masks[rows, order],
            self.grasps[rows, order],
        )

    def padded(self, count: int) -> "ObjectViews":
        """Return at least so many slots; the new ones are black, hidden and at the end."""
        extra = max(0, count - len(self))

        def longer(array: np.ndarray) -> np.ndarray:
            return np.pad(array, [(0, 0), (0, extra)] + [(0, 0)] * (array.ndim - 2))

        return ObjectViews(
            np.pad(self.ids, (0, extra), constant_values=-1),
            longer(self.crops),
            longer(self.boxes),
            longer(self.masks),
            longer(self.grasps),
        )

    @staticmethod
    def concatenated(images: Sequence["ObjectViews"]) -> "ObjectViews":
        """Put the objects of several images into one record, image after image."""
        if not images:
            return see_nothing()
        return ObjectViews(
            np.concatenate([image.ids for image in images]),
            np.concatenate([image.crops for image in images], axis=1),
            np.concatenate([image.boxes for image in images], axis=1),
            np.concatenate([image.masks for image in images], axis=1),
            np.concatenate([image.grasps for image in images], axis=1),
        )

    def visible(self) -> np.ndarray:
        """Whether each object shows in some view, shape (N,), bool."""
        return np.asarray(self.masks.any(axis=0))

    def positions(self) -> np.ndarray:
        """Points on the table under the centres of the boxes, shape (N, 2), float64, metres.

        The top view gives them; the front view stands in where an object is hidden from above.
        """
        return self._on_table(self.boxes[..., :2])

    def grasp_points(self) -> np.ndarray:
        """Points on the table under the most interior pixels, shape (N, 2), float64, metres."""
        return self._on_table(self.grasps)

    def _on_table(self, pixels: np.ndarray) -> np.ndarray:
        top = unproject(pixels[TOP].astype(np.float64), CAMERAS["top"])[:, :2]
        front = unproject(pixels[FRONT].astype(np.float64), CAMERAS["front"])[:, :2]
        return np.where(self.masks[TOP][:, None], top, front)


class ObjectFinder(Protocol):
    """Finds the objects in images: by their segmentation, or by a detector that knows pixels only."""

    def in_observation(self, observation: Mapping) -> ObjectViews:
        """Find the objects of an observation (`rgb`, `segm`, `ee`), from left to right."""
        ...

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        """Find the objects that a prompt's image shows."""
        ...


class GroundTruth:
    """Finds the objects by the simulator's segmentation, as the published policies do."""

    def in_observation(self, observation: Mapping) -> ObjectViews:
        """Find the objects of an observation; see `observe`."""
        return observe(observation)

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        """Find the objects that a prompt's image shows; see `observe_prompt_image`."""
        return observe_prompt_image(image)


GROUND_TRUTH = GroundTruth()


def see_nothing(count: int = 0) -> ObjectViews:
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
        rgb: View name to image, shape (3, H, W), uint8; height and width even.

    Returns:
        One slot, its crops of shape (2, 1, 3, H / 2, W / 2).

    Raises:
        ShapeError: An image has another shape or dtype.
    """
    for view in VIEWS:
        _check_rgb(view, rgb[view])
    frames = np.stack([rgb[view] for view in VIEWS])[:, None]
    height, width = frames.shape[-2:]
    blocks = frames.reshape(*frames.shape[:-2], height // 2, 2, width // 2, 2)
    sums = blocks.sum(axis=(-3, -1), dtype=np.uint16)
    centre = np.array([(width - 1) // 2, (height - 1) // 2])
    boxes = np.tile(np.array([*centre, height - 1, width - 1]), (len(VIEWS), 1, 1))
    return ObjectViews(
        np.full(1, -1),
        ((sums + 2) >> 2).astype(np.uint8),
        boxes,
        np.ones((len(VIEWS), 1), np.bool_),
        np.tile(centre, (len(VIEWS), 1, 1)),
    )


def see_objects(
    rgb: Mapping[str, np.ndarray], segm: Mapping[str, np.ndarray], object_ids: Sequence[int] | np.ndarray
) -> ObjectViews:
    """Cut the given objects out of the images of both views.

    Args:
        rgb: View name to image, shape (3, H, W), uint8.
        segm: View name to object ids, shape (H, W), uint8.
        object_ids: Which segmentation values are objects, in the order of the slots.

    Returns:
        One slot for each id, in both views, hidden or not.

    Raises:
        ShapeError: An image has another shape or dtype.
    """
    ids = np.asarray(object_ids, dtype=np.int64)
    views = replace(see_nothing(len(ids)), ids=ids)
    for view, name in enumerate(VIEWS):
        _check_images(name, rgb[name], segm[name])
        _cut_view(rgb[name], segm[name], views, view)
    return views


def observe(observation: Mapping) -> ObjectViews:
    """Find the objects of an observation, from left to right.

    Objects are all segmentation values from the end effector's first object id up to 254. Their order is that
    of the images, not of the ids, which could give away the order in which the task spawned them.

    Args:
        observation: `rgb` and `segm`, each view name to array, and `ee`, the index of the end effector.

    Returns:
        The objects that show at least two pixels in some view.
    """
    segm = observation["segm"]
    first = FIRST_OBJECT_ID[END_EFFECTORS[int(observation["ee"])]]
    present = np.unique(np.concatenate([np.unique(segm[view]) for view in VIEWS]))
    ids = present[(present >= first) & (present < BACKGROUND_ID)]
    return _left_to_right(see_objects(observation["rgb"], segm, ids))


def observe_prompt_image(image: PromptImage) -> ObjectViews:
    """Find the objects that a prompt's image shows, in the order of its records, hidden ones left out."""
    objects = see_objects(image.rgb, image.segm, [record.object_id for record in image.objects])
    return objects.select(objects.visible())


def _left_to_right(objects: ObjectViews) -> ObjectViews:
    objects = objects.select(objects.visible())
    points = objects.positions()
    return objects.select(np.lexsort((points[:, 0], points[:, 1])))


def crop_box(rgb: np.ndarray, extent: tuple[int, int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Cut an arbitrary rectangle out of an image, as if an object filled it.

    Args:
        rgb: Image, shape (3, H, W), uint8.
        extent: First and last column, first and last row, inclusive.

    Returns:
        The crop, shape (3, 32, 32), uint8, and the box, shape (4,), int64.
    """
    xmin, xmax, ymin, ymax = extent
    square = np.zeros((3, max(rgb.shape[1:]), max(rgb.shape[1:])), np.uint8)
    scratch = np.empty((CROP_SIZE, square.shape[2]))
    crop = np.empty((3, CROP_SIZE, CROP_SIZE), np.uint8)
    square_crop(rgb, xmin, xmax, ymin, ymax, square)
    resize_square(square, max(xmax - xmin, ymax - ymin) + 1, scratch, crop)
    return crop, np.array([(xmin + xmax) // 2, (ymin + ymax) // 2, ymax - ymin, xmax - xmin])


def _cut_view(rgb: np.ndarray, segm: np.ndarray, views: ObjectViews, view: int) -> None:
    count = len(views)
    rgb, segm = np.ascontiguousarray(rgb), np.ascontiguousarray(segm)
    slot_of_id = np.full(256, -1, np.int64)
    slot_of_id[views.ids] = np.arange(count)
    extents, num_pixels = np.empty((count, 4), np.int64), np.empty(count, np.int64)
    object_extents(segm, slot_of_id, extents, num_pixels)
    distance = np.empty((segm.shape[0] + 2, segm.shape[1] + 2), np.int32)
    for slot in np.flatnonzero(num_pixels >= MIN_PIXELS):
        xmin, xmax, ymin, ymax = (int(value) for value in extents[slot])
        views.crops[view, slot], views.boxes[view, slot] = crop_box(rgb, (xmin, xmax, ymin, ymax))
        views.masks[view, slot] = True
        most_interior_pixel(segm, views.ids[slot], extents[slot], distance, views.grasps[view, slot])


def _check_images(view: str, rgb: np.ndarray, segm: np.ndarray) -> None:
    _check_rgb(view, rgb)
    if segm.dtype != np.uint8 or segm.shape != rgb.shape[1:]:
        raise ShapeError(f"segm {view!r} is {segm.dtype} {segm.shape}; it must be uint8 {rgb.shape[1:]}.")


def _check_rgb(view: str, rgb: np.ndarray) -> None:
    if rgb.dtype != np.uint8 or rgb.ndim != 3 or rgb.shape[0] != 3:
        raise ShapeError(f"rgb {view!r} is {rgb.dtype} {rgb.shape}; it must be uint8 of shape (3, H, W).")
