"""Images by number, each stored once."""

import hashlib

import numpy as np


class ImageStack:
    """Collects images in the order in which they come; each is known by its number.

    Equal images share a number. Many are equal: what lies still looks the same at the next step.

    Args:
        image_size: Height and width of every image.
    """

    def __init__(self, image_size: tuple[int, int]) -> None:
        self._shape = (3, *image_size)
        self._images: list[np.ndarray] = []
        self._numbers: dict[bytes, int] = {}  # by digest, which is shorter than the image

    def add(self, images: np.ndarray) -> np.ndarray:
        """Append images of shape (..., 3, height, width) and return their numbers, shape (...), int64."""
        shape = images.shape[:-3]
        numbers = [self._number(image) for image in images.reshape(-1, *self._shape)]
        return np.array(numbers, np.int64).reshape(shape)

    def stacked(self) -> np.ndarray:
        """Return all images, shape (K, 3, height, width), uint8."""
        return np.array(self._images, np.uint8).reshape(-1, *self._shape)

    def _number(self, image: np.ndarray) -> int:
        digest = hashlib.blake2b(image.tobytes(), digest_size=16).digest()
        number = self._numbers.setdefault(digest, len(self._images))
        if number == len(self._images):
            self._images.append(image.copy())
        return number
