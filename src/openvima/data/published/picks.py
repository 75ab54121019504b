"""Which object an action picks, as far as the images tell."""

from collections.abc import Collection, Sequence

import numpy as np

from openvima.data.schema import UNKNOWN_ID
from openvima.render.camera import TOP, project
from openvima.scene import Action

# The original oracle chooses from a finer image, so at an edge its pixel can be a neighbour here.
_REACH_PX = 2
_AROUND = sorted(
    (
        (row, column)
        for row in range(-_REACH_PX, _REACH_PX + 1)
        for column in range(-_REACH_PX, _REACH_PX + 1)
    ),
    key=lambda offset: (offset[0] ** 2 + offset[1] ** 2, offset),
)


def picked_ids(segm: np.ndarray, actions: Sequence[Action], object_ids: Collection[int]) -> tuple[int, ...]:
    """Tell which object is where each action begins.

    Args:
        segm: Top view before each action, shape (T or more, 128, 256), uint8.
        actions: The T actions.
        object_ids: Ids of the objects; other values are floor, sheet and robot.

    Returns:
        T ids: of the pixel there, else of the nearest one within two pixels, else `schema.UNKNOWN_ID`.
    """
    points = np.array([(*action.pose0_position, 0.0) for action in actions])
    pixels = np.rint(project(points, TOP)).astype(int)
    return tuple(
        _nearest(image, pixel, object_ids) for image, pixel in zip(segm[: len(actions)], pixels, strict=True)
    )


def _nearest(image: np.ndarray, pixel: np.ndarray, object_ids: Collection[int]) -> int:
    height, width = image.shape
    for row_offset, column_offset in _AROUND:
        row, column = int(pixel[1]) + row_offset, int(pixel[0]) + column_offset
        if 0 <= row < height and 0 <= column < width and int(image[row, column]) in object_ids:
            return int(image[row, column])
    return UNKNOWN_ID
