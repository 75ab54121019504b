"""Grayscale prompt images, as in `novel_noun`: they identify an object by its shape alone."""

from dataclasses import replace

import numpy as np

from openvima.catalog.textures import NEUTRAL_TEXTURE
from openvima.scene import Placement
from openvima.tasks.table import NO_SCALE


def draw_grayscale(count: int, prob: float, rng: np.random.Generator) -> np.ndarray:
    """Draw which of some objects have a grayscale prompt image, shape (count,), bool."""
    return rng.random(count) < prob


def grayscale(placement: Placement) -> Placement:
    """Return an object as a grayscale prompt image shows it: neutral texture, no scale."""
    return replace(placement, texture=NEUTRAL_TEXTURE, scale=NO_SCALE)
