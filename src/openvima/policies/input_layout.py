"""What a network expects of its inputs."""

from dataclasses import dataclass
from typing import Literal

from openvima.perception.kernels import CROP_SIZE


@dataclass(frozen=True, slots=True)
class InputLayout:
    """How images become tokens.

    Args:
        tokens: What a token shows: an object in both views, an object in one view, or part of a whole frame.
        image_size: Height and width of a crop or frame.
        tokens_per_frame_pair: With frames, the number of tokens of a pair of them.
    """

    tokens: Literal["objects", "views", "frames"]
    image_size: tuple[int, int] = (CROP_SIZE, CROP_SIZE)
    tokens_per_frame_pair: int = 0
