"""Jitter of ground-truth boxes: objects whose boxes are a few pixels off, as those of a detector are."""

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

    def observation(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:  # Any: as the environment's
        """Return an observation with its objects, found beforehand."""
        if "segm" not in observation or "rgb" not in observation:
            return observation  # of a policy on whole frames
        frames = camera_frames(part_of(observation, "rgb"), "the observation's rgb")
        return {**observation, FOUND: self._moved(frames, observe(observation)).left_to_right()}

    def prompt_image(self, image: PromptImage) -> PromptImage:
        """Return a prompt image with its objects, found beforehand."""
        frames = camera_frames(image.rgb, f"the rgb of prompt image {image.name!r}")
        found = self._moved(frames, observe_prompt_image(image))
        return FoundImage(**{f.name: getattr(image, f.name) for f in fields(image)}, found=found)

    def _moved(self, frames: Mapping[str, np.ndarray], objects: ObjectViews) -> ObjectViews:
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
