"""The two layouts of images.

Images are channels first from the rasteriser through observations and demonstrations to the networks. Shards,
image files, video encoders and plots have them channels last.
"""

import numpy as np


def channels_last(images: np.ndarray) -> np.ndarray:
    """Return images of shape (..., C, H, W) as a view of shape (..., H, W, C)."""
    return np.moveaxis(images, -3, -1)


def channels_first(images: np.ndarray) -> np.ndarray:
    """Return images of shape (..., H, W, C) as a view of shape (..., C, H, W)."""
    return np.moveaxis(images, -1, -3)
