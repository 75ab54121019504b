"""Input format of a network."""

from dataclasses import dataclass
from typing import Literal

from openvima.perception.kernels import CROP_SIZE


@dataclass(frozen=True, slots=True)
class InputLayout:
    """How images are tokenized.

    Args:
        tokens: What a token encodes: an object in both views, an object in one view, or part of a frame.
        image_size: Height and width of a crop or frame.
        tokens_per_image: Number of tokens of both views of a prompt image or observation; 0 if it depends on
            their objects.
    """

    tokens: Literal["objects", "views", "frames"]
    image_size: tuple[int, int] = (CROP_SIZE, CROP_SIZE)
    tokens_per_image: int = 0
