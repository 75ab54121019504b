"""The two fixed cameras, projection between world and pixels, and the two layouts of images.

Images are channels first from the rasteriser through observations and demonstrations to the networks. Shards,
image files, video encoders and plots have them channels last.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from openvima.errors import ConfigError, ShapeError

View = Literal["front", "top"]
VIEWS: tuple[View, View] = ("front", "top")

Row = tuple[float, float, float, float]

MIN_DOUBLED_AREA_PX2 = 0.01  # triangles up to this doubled area are skipped, as in VIMA-Bench


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera about 1000 m away, nearly orthographic.

    A row (a, b, c, d) is the linear form a·x + b·y + c·z + d of a point (x, y, z) in the world, in metres.

    Args:
        view: Name of the view.
        width: Pixels across.
        height: Pixels down.
        focal_px: Focal length in pixels, equal for both axes.
        right: Row of the distance to the right of the optical axis.
        up: Row of the distance above the optical axis.
        away: Row of the distance in front of the camera plane.
        min_doubled_area_px2: Smaller triangles are not drawn.
    """

    view: View
    width: int
    height: int
    focal_px: float
    right: Row
    up: Row
    away: Row
    min_doubled_area_px2: float = MIN_DOUBLED_AREA_PX2

    def enlarged(self, factor: int) -> "Camera":
        """Return the same view at `factor` times the resolution.

        The lower left of every `factor` × `factor` pixels samples the same point as the plain image:
        `large[factor - 1 :: factor, ::factor]` is the plain image.

        Args:
            factor: Integer from 1.

        Raises:
            ConfigError: `factor` is below 1.
        """
        if factor < 1:
            raise ConfigError(f"enlarge is {factor}; it must be an integer from 1.")
        return replace(
            self,
            width=self.width * factor,
            height=self.height * factor,
            focal_px=self.focal_px * factor,
            min_doubled_area_px2=self.min_doubled_area_px2 * factor**2,
        )

    def matrix(self) -> np.ndarray:
        """Return the camera as a matrix for the kernels.

        Returns:
            Shape (4, 4), float64: rows right, up, away, then (focal length, half width, half height, smallest
            doubled area) in pixels.
        """
        numbers = (self.focal_px, self.width / 2, self.height / 2, self.min_doubled_area_px2)
        return np.array([self.right, self.up, self.away, numbers], dtype=np.float64)


# The focal lengths are whole pixels by construction (640000 // 2.55 and 640000 // 1.8). The constants of
# the front camera, 45 degrees down, are the float32 entries of VIMA-Bench's view matrix: rounder ones shift
# whole rows of pixels.
_COS_45 = 0.70710677
TOP = Camera(
    view="top",
    width=256,
    height=128,
    focal_px=250980.0,
    right=(0.0, 1.0, 0.0, 0.0),
    up=(-1.0, 0.0, 0.0, 0.5),
    away=(0.0, 0.0, -1.0, 1000.0),
)
FRONT = Camera(
    view="front",
    width=256,
    height=128,
    focal_px=355555.0,
    right=(0.0, 1.0, 0.0, 0.0),
    up=(-_COS_45, 0.0, _COS_45, 0.2899170),
    away=(-_COS_45, 0.0, -_COS_45, 1414.503418),
)
CAMERAS: dict[View, Camera] = {"front": FRONT, "top": TOP}


def project(points: np.ndarray, camera: Camera) -> np.ndarray:
    """Project world points to pixel coordinates of one view.

    Args:
        points: Positions in metres, shape (..., 3); x away from the robot, y to its left, z up.
        camera: The view; its image is `camera.height` × `camera.width` pixels.

    Returns:
        Shape (..., 2), float64: column, then row, row 0 on top. Integers are the sampling
        points of pixels. Nothing is clipped.

    Example:
        >>> project(np.array([0.5, 0.0, 0.0]), TOP)
        array([128.,  63.])

    Source: pinhole model with the constants of VIMA-Bench.
    """
    points = np.asarray(points, dtype=np.float64)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    right, up, away = (a * x + b * y + c * z + d for a, b, c, d in (camera.right, camera.up, camera.away))
    columns = camera.width / 2 + camera.focal_px * right / away
    heights = camera.height / 2 + camera.focal_px * up / away
    return np.stack([columns, camera.height - 1 - heights], axis=-1)


def unproject(pixels: np.ndarray, camera: Camera, z: float | np.ndarray = 0.0) -> np.ndarray:
    """Unproject pixel coordinates of one view to points at a known height.

    Args:
        pixels: Column, then row, shape (..., 2); see `project`.
        camera: The view.
        z: Height above the table in metres, one number or shape (...).

    Returns:
        x, y in metres, shape (..., 2), float64; the inverse of `project`.

    Example:
        >>> unproject(np.array([128.0, 63.0]), TOP)
        array([0.5, 0. ])
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    tangent_right = (pixels[..., 0] - camera.width / 2) / camera.focal_px
    tangent_up = (camera.height - 1 - pixels[..., 1] - camera.height / 2) / camera.focal_px
    # right = tangent_right · away and up = tangent_up · away: two linear equations for x and y.
    equations = []
    for row, tangent in ((camera.right, tangent_right), (camera.up, tangent_up)):
        a, b, c, d = (own - tangent * far for own, far in zip(row, camera.away, strict=True))
        equations.append((a, b, -(c * z + d)))
    (a0, b0, c0), (a1, b1, c1) = equations
    determinant = a0 * b1 - a1 * b0
    x, y = (c0 * b1 - c1 * b0) / determinant, (a0 * c1 - a1 * c0) / determinant
    return np.stack([x, y], axis=-1)


def points_from_depth(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Unproject a depth image of one view to points in the world.

    Args:
        depth: Metres from the camera plane, along the optical axis, shape (H, W); infinite for background.
        camera: The view.

    Returns:
        Positions in metres of the surface that each pixel samples, shape (H, W, 3), float64; NaN for
        background.

    Raises:
        ShapeError: The depth image has another size than the camera's.
    """
    if depth.shape != (camera.height, camera.width):
        raise ShapeError(
            f"depth has shape {depth.shape}; the {camera.view} camera takes {(camera.height, camera.width)}."
        )
    rows, columns = np.indices(depth.shape)
    away = np.where(np.isfinite(depth), depth, np.nan).astype(np.float64)
    right = (columns - camera.width / 2) / camera.focal_px * away
    up = (camera.height - 1 - rows - camera.height / 2) / camera.focal_px * away
    world_to_camera = np.array([camera.right, camera.up, camera.away])
    seen = np.stack([right, up, away], axis=-1) - world_to_camera[:, 3]
    return seen @ np.linalg.inv(world_to_camera[:, :3]).T


def channels_last(images: np.ndarray) -> np.ndarray:
    """Return images of shape (..., C, H, W) as a view of shape (..., H, W, C)."""
    return np.moveaxis(images, -3, -1)


def channels_first(images: np.ndarray) -> np.ndarray:
    """Return images of shape (..., H, W, C) as a view of shape (..., C, H, W)."""
    return np.moveaxis(images, -1, -3)
