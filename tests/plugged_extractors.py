"""Object extractors of a user's own, as tests plug them in."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openvima.perception.objects import (
    GROUND_TRUTH,
    ObjectViews,
    make_hidden_objects,
    observe,
    observe_prompt_image,
)
from openvima.scene import PromptImage


def truth():
    """What the segmentation says."""
    return GROUND_TRUTH


class Blind:
    """Finds nothing on the table, and in a prompt two objects that no view shows."""

    def in_observation(self, observation):
        return make_hidden_objects()

    def in_prompt_image(self, image):
        return make_hidden_objects(2)


HOOK = f"{Path(__file__)}:make"


@dataclass(frozen=True)
class NoisyExtractor:
    """Moves boxes, loses every third object and ids, is blind now and then, and orders from right to left.

    Args:
        pixels: How far boxes are moved.
    """

    pixels: int = 2

    def in_observation(self, observation: Mapping) -> ObjectViews:
        """Find the objects of an observation."""
        return self._seen(observe(observation), observation["rgb"]["front"])

    def in_prompt_image(self, image: PromptImage) -> ObjectViews:
        """Find the objects of a prompt's image."""
        return self._seen(observe_prompt_image(image).left_to_right(), image.rgb["front"])

    def _seen(self, true: ObjectViews, rgb: np.ndarray) -> ObjectViews:
        if int(rgb.sum()) % 5 == 0:
            return make_hidden_objects()
        found = true.select(np.array([slot for slot in range(len(true)) if slot % 3 != 1][::-1], np.int64))
        found.boxes[..., :2] += self.pixels * found.masks[..., None]
        found.ids[:] = -1
        return found


def make() -> NoisyExtractor:
    """Make one, for a hook."""
    return NoisyExtractor()
