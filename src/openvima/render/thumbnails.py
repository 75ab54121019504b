"""Thumbnails of single objects with a transparent background."""

from typing import Literal

import numpy as np

from openvima.catalog import object_spec
from openvima.catalog.geometry import TriangleMesh
from openvima.render import channels_last
from openvima.render.camera import View
from openvima.render.rasteriser import Drawable, Rasteriser
from openvima.scene import Pose, Scene

Detail = Literal[1, 2]

_OBJECT_ID = 9
_WIDTH_M, _HEIGHT_M = 0.64, 0.48  # of the window of a thumbnail
_PX_PER_M = 250  # of both views at benchmark resolution, slightly less than theirs
_FILLED_FRACTION = 0.94
_SAMPLES = 2  # per pixel and axis, for anti-aliasing
_LONG = 2  # aspect ratio from which an object is drawn horizontally


def draw_thumbnail(
    rasteriser: Rasteriser, object_name: str, texture_name: str, view: View, *, detail: Detail = 1
) -> np.ndarray:
    """Draw an object of the catalogue so that it fills the image.

    The pose is that of prompt images, so that letters are upright; long objects are horizontal.

    Args:
        rasteriser: Rasteriser with the asset pack.
        object_name: Display name.
        texture_name: Display name.
        view: "front" looks down at 45 degrees, "top" from above.
        detail: 1 for 240 × 320 pixels, 2 for 480 × 640.

    Returns:
        Red, green, blue and opacity, shape (240 · detail, 320 · detail, 4), uint8, row 0 on top.

    Raises:
        UnknownObjectError, UnknownTextureError, AssetError: The pack has no such shape or texture.
    """
    mesh = rasteriser.assets.geometry(object_name, object_spec(object_name).size_max).visual
    texture = rasteriser.assets.texture(texture_name)
    low, high = (bound(mesh.vertices, axis=(0, 1)) for bound in (np.min, np.max))
    length_x, length_y, length_z = (high - low).tolist()
    is_across = length_y > _LONG * length_x
    across, along = (length_y, length_x) if is_across else (length_x, length_y)
    upwards = along if view == "top" else (along + length_z) / np.sqrt(2)
    factor = _FILLED_FRACTION * min(_WIDTH_M / across, _HEIGHT_M / upwards)
    foot = np.array([*(low + high)[:2] / 2, low[2]])
    magnified = TriangleMesh((mesh.vertices - foot) * factor, mesh.normals, mesh.uvs)
    pose = Pose.planar(0.5, 0.0, 0.0 if is_across else np.pi / 2)
    body = Drawable(magnified, pose, _OBJECT_ID, texture)
    enlarge = 2 * detail * _SAMPLES
    rendered = rasteriser.scene(Scene(()), views=(view,), extra=(body,), enlarge=enlarge)[view]
    opaque = rendered.segm == _OBJECT_ID
    return _antialiased(_cropped(channels_last(rendered.rgb), opaque, enlarge), _SAMPLES)


def _cropped(rgb: np.ndarray, opaque: np.ndarray, enlarge: int) -> np.ndarray:
    """Crop the window around the object, shape (H, W, 4), uint8."""
    height, width = (round(length * _PX_PER_M * enlarge) for length in (_HEIGHT_M, _WIDTH_M))
    rows, columns = np.flatnonzero(opaque.any(axis=1)), np.flatnonzero(opaque.any(axis=0))
    top = (rows[0] + rows[-1] + 1 - height) // 2
    left = (columns[0] + columns[-1] + 1 - width) // 2
    image = np.concatenate([rgb, np.where(opaque, 255, 0)[..., None].astype(np.uint8)], axis=2)
    image = np.pad(image, ((height, height), (width, width), (0, 0)))
    return image[top + height : top + 2 * height, left + width : left + 2 * width]


def _antialiased(image: np.ndarray, samples: int) -> np.ndarray:
    """Average squares of pixels; transparent ones give no colour."""
    height, width = image.shape[0] // samples, image.shape[1] // samples
    squares = image.reshape(height, samples, width, samples, 4)
    sums = np.zeros((height, width, 4))
    for row, column in np.ndindex(samples, samples):
        sample = squares[:, row, :, column].astype(np.float64)
        sums[..., :3] += sample[..., :3] * sample[..., 3:]
        sums[..., 3:] += sample[..., 3:]
    colour = sums[..., :3] / np.maximum(sums[..., 3:], 1)
    return np.rint(np.concatenate([colour, sums[..., 3:] / samples**2], axis=2)).astype(np.uint8)
