"""Boxes of objects: intersection over union, matching of detected to true objects by it, and jitter."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from openvima.perception.objects import (
    ObjectViews,
    crop_box,
    observation_frames,
    observe,
    observe_prompt_image,
    prompt_image_frames,
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
    pairs = match_greedily(np.where(iou >= IOU_THRESHOLD, -iou, np.inf))
    return {int(true.ids[row]): slot for slot, row in pairs}


def match_greedily(costs: np.ndarray) -> list[tuple[int, int]]:
    """Match rows to columns: repeatedly the pair with the lowest cost, of equal ones the first.

    Args:
        costs: Shape (rows, columns), float64; infinite where there must be no match.

    Returns:
        Row and column of each pair.
    """
    costs, pairs = costs.copy(), []
    while np.isfinite(costs).any():
        row, column = (int(index) for index in np.unravel_index(costs.argmin(), costs.shape))
        pairs.append((row, column))
        costs[row], costs[:, column] = np.inf, np.inf
    return pairs


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
        found = self._move(observation_frames(observation), observe(observation))
        return {**observation, FOUND: found.left_to_right()}

    def prompt_image(self, image: PromptImage) -> PromptImage:
        """Return a prompt image with its objects, found beforehand."""
        found = self._move(prompt_image_frames(image), observe_prompt_image(image))
        return FoundImage(**{f.name: getattr(image, f.name) for f in fields(image)}, found=found)

    def _move(self, frames: Mapping[str, np.ndarray], objects: ObjectViews) -> ObjectViews:
        crops, boxes, grasps = objects.crops.copy(), objects.boxes.copy(), objects.grasps.copy()
        for v, view in enumerate(VIEWS):
            limits = np.array(frames[view].shape[:0:-1])[:, None] - 1  # of columns and rows
            for k in np.flatnonzero(objects.masks[v]):
                centre, size = objects.boxes[v, k, :2], objects.boxes[v, k, :1:-1]
                # The centre of a box is rounded down, so twice the centre lacks the parity of the size.
                first = (2 * centre + size % 2 - size) // 2
                shifts = self.rng.integers(-self.pixels, self.pixels, (2, 2), endpoint=True)
                edges = np.stack([first, first + size], axis=1) + shifts
                extent = np.sort(edges.clip(0, limits), axis=1)
                crops[v, k], boxes[v, k] = crop_box(frames[view], extent.ravel().tolist())
                grasps[v, k] = (grasps[v, k] + boxes[v, k, :2] - centre).clip(*extent.T)
        return replace(objects, crops=crops, boxes=boxes, grasps=grasps)
