"""Short animations of episodes in memory, for experiment trackers."""

import io
from dataclasses import dataclass

import numpy as np
from PIL import Image


@dataclass(frozen=True, slots=True, eq=False)
class Animation:
    """An episode as it was rolled out.

    Args:
        name: Such as the task.
        caption: How the episode ended.
        prompt: The prompt as a picture, shape (H, W, 3), uint8.
        frames: Shape (T, H, W, 3), uint8.
        frames_per_second: Frame rate.
    """

    name: str
    caption: str
    prompt: np.ndarray
    frames: np.ndarray
    frames_per_second: int

    def gif(self) -> bytes:
        """Encode the frames as an animated GIF, which needs no further package."""
        first, *others = map(Image.fromarray, self.frames)
        content = io.BytesIO()
        duration_ms = 1000 // self.frames_per_second
        first.save(content, "GIF", save_all=True, append_images=others, duration=duration_ms, loop=0)
        return content.getvalue()
