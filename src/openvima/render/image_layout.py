"""The two layouts of images.

Images are channels first throughout the package, from the rasteriser through observations, demonstrations
and shards to the networks. Image files, video encoders and plots take them channels last.
"""

import numpy as np


def channels_last(images: np.ndarray) -> np.ndarray:
    """Return images of shape (..., C, H, W) as a view of shape (..., H, W, C)."""
    return np.moveaxis(images, -3, -1)


def channels_first(images: np.ndarray) -> np.ndarray:
    """Return images of shape (..., H, W, C) as a view of shape (..., C, H, W)."""
    return np.moveaxis(images, -1, -3)
