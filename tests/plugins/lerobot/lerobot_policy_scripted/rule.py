"""A rule for `rotate` from language and pixels: find the object of the prompt image, turn it as asked."""

import re

import numpy as np

from openvima.render.camera import TOP, unproject

LEVELS = 8  # of each colour channel that are told apart
REACH = 8  # pixels of an object's middle to its edge, about


def rotate_row(text: str, prompt: np.ndarray, scene: np.ndarray) -> np.ndarray:
    """Return the action, shape (12,), float32.

    Args:
        text: The prompt.
        prompt: Top view of the prompt image, shape (3, H, W), within 0 … 1.
        scene: Top view of the scene, alike.
    """
    wanted, seen = _codes(prompt), _codes(scene)
    counts = np.bincount(wanted.ravel(), minlength=LEVELS**3).astype(float)
    counts[np.argmax(counts)] = 0  # the background
    is_table = np.bincount(seen.ravel(), minlength=LEVELS**3) > 0.2 * seen.size
    counts[is_table] = 0
    scores = counts[seen]
    sums = np.pad(scores, REACH).cumsum(0).cumsum(1)
    boxes = sums[2 * REACH :, 2 * REACH :] - sums[: -2 * REACH, 2 * REACH :]
    boxes += sums[: -2 * REACH, : -2 * REACH] - sums[2 * REACH :, : -2 * REACH]
    row, column = np.unravel_index(np.argmax(boxes), boxes.shape)
    x, y = unproject(np.array([float(column), float(row)]), TOP)
    half = -np.deg2rad(float(re.findall(r"(\d+) degrees", text)[0])) / 2
    return np.array([x, y, 0, 0, 0, 1, x, y, 0, 0, np.sin(half), np.cos(half)], np.float32)


def _codes(image: np.ndarray) -> np.ndarray:
    red, green, blue = np.clip(image * LEVELS, 0, LEVELS - 1).astype(int)
    return (red * LEVELS + green) * LEVELS + blue
