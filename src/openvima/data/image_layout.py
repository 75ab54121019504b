"""Images with their colours last, as shards store them, and first, as observations have them."""

from collections.abc import Sequence

import numpy as np

from openvima.data.schema import ARRAYS, IMAGE_SHAPE

_NUM_PIXELS = IMAGE_SHAPE[0] * IMAGE_SHAPE[1]


class ImageBuffers:
    """Reusable memory for the images of an episode: allocating costs more than filling."""

    def __init__(self) -> None:
        self._arrays: dict[str, np.ndarray] = {}

    def images(self, name: str, count: int) -> np.ndarray:
        """Return room for images, valid until the next call.

        Args:
            name: Column that they are for; each has its own memory.
            count: Number of images.

        Returns:
            An array of uint8 with the shape of the column.
        """
        _, shape = ARRAYS[name]
        if name not in self._arrays or count > len(self._arrays[name]):
            self._arrays[name] = np.empty((count, *shape), np.uint8)
        return self._arrays[name][:count]

    def owns(self, name: str, memory: np.ndarray) -> bool:
        """Tell whether an array is the present memory of a column."""
        return self._arrays.get(name) is memory


def pixels(planes: np.ndarray | Sequence[np.ndarray], out: np.ndarray) -> np.ndarray:
    """Copy images so that their colours come last.

    Args:
        planes: N images of shape (3, 128, 256), uint8.
        out: Where to, shape (N, 128, 256, 3), uint8, contiguous; also what is returned.
    """
    from openvima.data.kernels import join_colours  # Numba takes a moment to be imported

    parts = [planes] if isinstance(planes, np.ndarray) else [image[np.newaxis] for image in planes]
    joined, end = out.reshape(len(out), 3 * _NUM_PIXELS), 0
    for part in parts:
        start, end = end, end + len(part)
        join_colours(np.ascontiguousarray(part).reshape(-1, 3, _NUM_PIXELS), joined[start:end])
    return out


def planes(pixels: np.ndarray) -> np.ndarray:
    """Return images with their colours first, as observations have them.

    Args:
        pixels: Shape (N, 128, 256, 3), uint8, contiguous.

    Returns:
        A copy of shape (N, 3, 128, 256), uint8, contiguous.
    """
    from openvima.data.kernels import part_colours

    parted = np.empty((len(pixels), 3, *IMAGE_SHAPE), np.uint8)
    part_colours(pixels.reshape(-1, 3 * _NUM_PIXELS), parted.reshape(-1, 3, _NUM_PIXELS))
    return parted
