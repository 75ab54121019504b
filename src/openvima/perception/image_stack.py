"""Images by index, each stored once."""

import hashlib

import numpy as np


class ImageStack:
    """Collects images; equal ones share an index, and index 0 is a blank image for what is hidden.

    Many images are equal: an object that does not move has the same crop at the next step.

    Args:
        image_size: Height and width of every image.
    """

    def __init__(self, image_size: tuple[int, int]) -> None:
        self.image_size = image_size
        self._shape = (3, *image_size)
        self._images = [np.zeros(self._shape, np.uint8)]
        self._index: dict[bytes, int] = {b"": 0}  # by digest, which is shorter than the image

    def add(self, images: np.ndarray) -> np.ndarray:
        """Append images of shape (..., 3, height, width) and return their indices, shape (...), int64."""
        shape = images.shape[:-3]
        index = [self._add(image) for image in images.reshape(-1, *self._shape)]
        return np.array(index, np.int64).reshape(shape)

    def images(self) -> np.ndarray:
        """Return all images, the blank one first, shape (K, 3, height, width), uint8."""
        return np.stack(self._images)

    def digests(self) -> list[bytes]:
        """Return what identifies the content of each image, in the order of `images`."""
        return list(self._index)

    def _add(self, image: np.ndarray) -> int:
        digest = hashlib.blake2b(image.tobytes(), digest_size=16).digest()
        index = self._index.setdefault(digest, len(self._images))
        if index == len(self._images):
            self._images.append(image.copy())
        return index
