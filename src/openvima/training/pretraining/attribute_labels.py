"""What rendered objects are like: labels of the attributes in which contrastive pretraining compares them."""

import math
from dataclasses import dataclass

import numpy as np
import torch

from openvima.catalog.geometry import Assets
from openvima.catalog.objects import object_spec
from openvima.catalog.random_pack import is_random
from openvima.policies.nn.tensor_record import TensorRecord
from openvima.scene import Placement

_CATEGORIES = ("texture", "shape", "profile")
_NUM_LEVELS = 4  # of each channel of a colour histogram
_ROUND_WITHIN = 1.03  # ratio of the largest and the smallest width of a circle, which is a polygon here
_SQUARE_WITHIN = 1.25  # ratio of sides; that of the catalogue's pallet, whose profile is square, is 1.2


@dataclass(frozen=True, slots=True, eq=False)
class AttributeLabels(TensorRecord):
    """What K objects are like in their prompt image and in their scene.

    Args:
        categories: Index of texture, shape and profile, shape (K, 2, 3), int64.
        colours: Histograms of colours, shape (K, 2, 64), float32.
        lengths: Height, and mean width of the footprint, in metres; NaN if magnified. Shape (K, 2, 2),
            float32.
        boxes: In prompt image, scene and second view, in pixels, shape (K, 3, 2, 4), int64.
    """

    categories: torch.Tensor
    colours: torch.Tensor
    lengths: torch.Tensor
    boxes: torch.Tensor


class AttributeLabeller:
    """Labels placements; indices of categories count through all calls.

    Args:
        assets: Source of shapes and textures.
    """

    def __init__(self, assets: Assets) -> None:
        self._assets = assets
        self._indices: dict[tuple[str, str], int] = {}
        self._colours: dict[str, np.ndarray] = {}

    def __call__(
        self, placement: Placement, *, is_magnified: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return categories (3,), colours (64,) and lengths (2,) of an object."""
        vertices = self._assets.geometry(placement.object, placement.size, placement.scale).visual.vertices
        vertices = vertices.reshape(-1, 3)
        names = (placement.texture, placement.object, profile(placement.object, vertices))
        keys = zip(_CATEGORIES, names, strict=True)
        categories = [self._indices.setdefault(key, len(self._indices)) for key in keys]
        if placement.texture not in self._colours:
            self._colours[placement.texture] = _histogram(self._assets.texture(placement.texture))
        lengths = [np.ptp(vertices[:, 2]), _widths(vertices).mean()]
        known = np.array(lengths, np.float32) if not is_magnified else np.full(2, np.nan, np.float32)
        return np.array(categories), self._colours[placement.texture], known


def profile(object_name: str, vertices: np.ndarray) -> str:
    """Return "circle", "square", or the object's name, since any other outline is a class of its own.

    Args:
        object_name: Of the catalogue, or random: of those only containers can be round or square.
        vertices: Shape (N, 3), metres.
    """
    if not is_random(object_name):
        return object_spec(object_name).profile or object_name
    if "container" not in object_name:
        return object_name
    widths = _widths(vertices)
    if widths.max() < _ROUND_WITHIN * widths.min():
        return "circle"
    middle = vertices[:, :2] - (vertices[:, :2].max(axis=0) + vertices[:, :2].min(axis=0)) / 2
    x, y = np.abs(middle).max(axis=0)
    corners = (middle / (x, y)) @ np.array([(1, 1), (1, -1), (-1, 1), (-1, -1)]).T
    has_corners = corners.max(axis=0).min() > 1.9
    return "square" if has_corners and max(x, y) < _SQUARE_WITHIN * min(x, y) else object_name


def _widths(vertices: np.ndarray) -> np.ndarray:
    """Widths of a footprint in 36 directions, metres."""
    angles = np.arange(36) * math.pi / 36
    along = vertices[:, :2] @ np.stack([np.cos(angles), np.sin(angles)])
    return np.ptp(along, axis=0)


def _histogram(texture: np.ndarray) -> np.ndarray:
    """Soft histogram of the colours of a texture, shape (64,), float32; its sum is 1."""
    pixels = texture.reshape(-1, 3)[:: max(1, texture.shape[0] * texture.shape[1] // 4096)]
    position = pixels / 255 * (_NUM_LEVELS - 1)
    weights = np.maximum(0, 1 - np.abs(position[..., None] - np.arange(_NUM_LEVELS)))  # (N, 3, levels)
    cells = np.einsum("ni,nj,nk->ijk", *weights.transpose(1, 0, 2)) / len(pixels)
    return cells.reshape(-1).astype(np.float32)
