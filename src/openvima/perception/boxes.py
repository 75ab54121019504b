"""Boxes of objects: intersection over union, matching of detected to true objects by it, and jitter."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from openvima.perception.objects import (
    ObjectViews,
    camera_frames,
    crop_box,
    observe,
    observe_prompt_image,
    part_of,
)
from openvima.perception.preprocessing import FOUND, FoundImage
from openvima.render.camera import VIEWS
from openvima.scene import PromptImage

IOU_THRESHOLD = 0.5  # of a match


def object_iou(objects: ObjectViews, others: ObjectViews) -> np.ndarray:
    """Return the pairwise IoU of objects, shape (objects, others), float64.

    It is the larger one of both views; 0 where no view contains both boxes.
    """
    return box_iou(objects.boxes, objects.masks, others.boxes, others.masks)


def box_iou(
    boxes: np.ndarray, is_visible: np.ndarray, others: np.ndarray, others_visible: np.ndarray
) -> np.ndarray:
    """Return the same for boxes, (2, N, 4) and (2, M, 4), with visibility masks, (2, N) and (2, M)."""
    ours, theirs = _edges(boxes)[:, :, None], _edges(others)[:, None]
    first, last = np.maximum(ours[..., :2], theirs[..., :2]), np.minimum(ours[..., 2:], theirs[..., 2:])
    intersection = np.prod(np.maximum(last - first, 0), axis=-1)
    both_visible = is_visible[:, :, None] & others_visible[:, None]
    union = _areas(ours) + _areas(theirs) - intersection
    return np.where(both_visible, intersection / union, 0.0).max(axis=0)


def match_ids_to_slots(found: ObjectViews, true: ObjectViews) -> dict[int, int]:
    """Match true objects to detections greedily, by descending IoU.

    Args:
        found: Detected objects.
        true: Objects of the segmentation in the same observation.

    Returns:
        Id of a true object to its slot in `found`; objects below `IOU_THRESHOLD` are omitted.
    """
    iou = object_iou(found, true)
    slots = {}
    while iou.size and iou.max() >= IOU_THRESHOLD:
        slot, row = (int(index) for index in np.unravel_index(iou.argmax(), iou.shape))
        slots[int(true.ids[row])] = slot
        iou[slot], iou[:, row] = 0, 0
    return slots


def _edges(boxes: np.ndarray) -> np.ndarray:
    """Left, upper, right and lower edge of the boxes, shape (2, N, 4); a pixel is one wide."""
    sizes = boxes[..., :1:-1]  # width and height, one pixel short
    first = boxes[..., :2] - sizes // 2
    return np.concatenate([first, first + sizes + 1], axis=-1)


def _areas(edges: np.ndarray) -> np.ndarray:
    return np.prod(edges[..., 2:] - edges[..., :2], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class BoxJitter:
    """Moves the borders of boxes by whole pixels, uniform within ± `pixels`, each by its own draw.

    Crops are taken inside the moved boxes, which stay within the image. Grasp points move with the centres.
    No object is lost, and images stay as they are: policies on whole frames see no difference.

    Args:
        pixels: Largest shift of a border.
        rng: Generator of the episode; the draws follow the order of its images.
    """

    pixels: int
    rng: np.random.Generator

    def observation(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return an observation with its objects, found beforehand."""
        if "segm" not in observation or "rgb" not in observation:
            return observation  # of a policy on whole frames
        frames = camera_frames(part_of(observation, "rgb"), "the observation's rgb")
        return {**observation, FOUND: self._move(frames, observe(observation)).left_to_right()}

    def prompt_image(self, image: PromptImage) -> PromptImage:
        """Return a prompt image with its objects, found beforehand."""
        frames = camera_frames(image.rgb, f"the rgb of prompt image {image.name!r}")
        found = self._move(frames, observe_prompt_image(image))
        return FoundImage(**{f.name: getattr(image, f.name) for f in fields(image)}, found=found)

    def _move(self, frames: Mapping[str, np.ndarray], objects: ObjectViews) -> ObjectViews:
        crops, boxes, grasps = objects.crops.copy(), objects.boxes.copy(), objects.grasps.copy()
        for v, view in enumerate(VIEWS):
            height, width = frames[view].shape[1:]
            for k in np.flatnonzero(objects.masks[v]):
                x, y, tall, wide = objects.boxes[v, k].tolist()
                # The centre of a box is rounded down, so twice the centre lacks the parity of the size.
                left, upper = (2 * x + wide % 2 - wide) // 2, (2 * y + tall % 2 - tall) // 2
                shifts = self.rng.integers(-self.pixels, self.pixels, 4, endpoint=True)
                edges = np.array([left, left + wide, upper, upper + tall]) + shifts
                columns = np.sort(edges[:2].clip(0, width - 1))
                rows = np.sort(edges[2:].clip(0, height - 1))
                crops[v, k], boxes[v, k] = crop_box(frames[view], [*columns.tolist(), *rows.tolist()])
                moved = grasps[v, k] + boxes[v, k, :2] - (x, y)
                grasps[v, k] = moved.clip((columns[0], rows[0]), (columns[1], rows[1]))
        return replace(objects, crops=crops, boxes=boxes, grasps=grasps)
