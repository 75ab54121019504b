"""What rendered objects are like: labels of the attributes in which contrastive pretraining compares them."""

import hashlib
import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from openvima.catalog.geometry import Assets
from openvima.catalog.objects import object_spec
from openvima.catalog.random_pack import is_random
from openvima.policies.nn.tensor_record import TensorRecord
from openvima.scene import Placement

_NUM_LEVELS = 4  # of each channel of a colour histogram
_NUM_DIRECTIONS = 72
_CORNERS = slice(_NUM_DIRECTIONS // 8, None, _NUM_DIRECTIONS // 4)  # the four diagonals
_ROUND_FROM = 0.9  # smallest reach of a circle, as a fraction of the largest; 0.92 for an octagon
_CORNERS_FROM = 1.75  # reach of a square into its corners, which is 2 unless they are open
_SIDES_WITHIN = 1.25  # ratio of the sides of a square; that of the catalogue's pallet is 1.2


@dataclass(frozen=True, slots=True, eq=False)
class AttributeLabels(TensorRecord):
    """What K objects are like in their prompt image and in their scene.

    Args:
        categories: `name_id` of texture, shape and profile, shape (K, 2, 3), int64.
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
    """Labels placements.

    Args:
        assets: Source of shapes and textures.
    """

    def __init__(self, assets: Assets) -> None:
        self._assets = assets
        self._colours: dict[str, np.ndarray] = {}

    def __call__(
        self, placement: Placement, *, is_magnified: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return categories (3,), colours (64,) and lengths (2,) of an object."""
        vertices = self._vertices(placement)
        # Ears are drawn after the container of the same seed; they change its outline, and not its profile.
        body = replace(placement, object=placement.object.replace("random eared", "random"))
        names = (placement.texture, placement.object, profile(body.object, self._vertices(body)))
        if placement.texture not in self._colours:
            self._colours[placement.texture] = _histogram(self._assets.texture(placement.texture))
        # The mean width of a footprint is twice its mean reach, whatever the middle.
        lengths = [np.ptp(vertices[:, 2]), 2 * _reach(vertices[:, :2]).mean()]
        known = np.array(lengths, np.float32) if not is_magnified else np.full(2, np.nan, np.float32)
        return np.array([name_id(name) for name in names]), self._colours[placement.texture], known

    def _vertices(self, placement: Placement) -> np.ndarray:
        mesh = self._assets.geometry(placement.object, placement.size, placement.scale).visual
        return mesh.vertices.reshape(-1, 3)


def name_id(*names: str) -> np.int64:
    """Return a number for names, the same in every process; different names have different ones."""
    digest = hashlib.blake2b("/".join(names).encode(), digest_size=8).digest()
    return np.int64(int.from_bytes(digest, "little") >> 1)


def profile(object_name: str, vertices: np.ndarray) -> str:
    """Return "circle", "square", or the object's name, since any other outline is a class of its own.

    Args:
        object_name: Of the catalogue, or random; a random shape is a class of its own.
        vertices: Shape (N, 3), metres.
    """
    if not is_random(object_name):
        return object_spec(object_name).profile or object_name
    if "shape" in object_name:
        return object_name
    points = vertices[:, :2] - (vertices[:, :2].max(axis=0) + vertices[:, :2].min(axis=0)) / 2
    reach = _reach(points)
    if reach.min() > _ROUND_FROM * reach.max():
        return "circle"
    return (
        "square" if any(_is_square(points @ _rotation(angle)) for angle in (0, math.pi / 4)) else object_name
    )


def _is_square(points: np.ndarray) -> bool:
    """Whether a footprint about the origin is a square along the axes, or nearly so."""
    x, y = np.abs(points).max(axis=0)
    corners = _reach(points / (x, y))[_CORNERS] * math.sqrt(2)
    return bool(corners.min() > _CORNERS_FROM and max(x, y) < _SIDES_WITHIN * min(x, y))


def _reach(points: np.ndarray) -> np.ndarray:
    """How far a footprint reaches in each of 72 directions, the first along x."""
    angles = np.arange(_NUM_DIRECTIONS) * (2 * math.pi / _NUM_DIRECTIONS)
    return (points @ np.stack([np.cos(angles), np.sin(angles)])).max(axis=0)


def _rotation(angle_rad: float) -> np.ndarray:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([(cos, sin), (-sin, cos)])


def _histogram(texture: np.ndarray) -> np.ndarray:
    """Soft histogram of the colours of a texture, shape (64,), float32; its sum is 1."""
    pixels = texture.reshape(-1, 3)[:: max(1, texture.shape[0] * texture.shape[1] // 4096)]
    position = pixels / 255 * (_NUM_LEVELS - 1)
    weights = np.maximum(0, 1 - np.abs(position[..., None] - np.arange(_NUM_LEVELS)))  # (N, 3, levels)
    cells = np.einsum("ni,nj,nk->ijk", *weights.transpose(1, 0, 2)) / len(pixels)
    return cells.reshape(-1).astype(np.float32)
