"""An asset pack of plain boxes, so that tests of the renderer depend on no other pack."""

from functools import lru_cache

import numpy as np

from openvima.catalog import Geometry, TriangleMesh, Vector3
from openvima.catalog.bodies import block

COLOURS = {"red": (255, 87, 89), "blue": (78, 121, 167), "white": (255, 255, 255)}


@lru_cache
def _block(size: Vector3) -> Geometry:
    return block(size)


class BoxAssets:
    """Every object is a box of its size; textures are plain colours."""

    name = "boxes"

    def geometry(self, object_name: str, size: Vector3, scale: Vector3 = (1.0, 1.0, 1.0)) -> Geometry:
        return _block((size[0] * scale[0], size[1] * scale[1], size[2] * scale[2]))

    def texture(self, texture_name: str) -> np.ndarray:
        return np.array(COLOURS[texture_name], dtype=np.uint8).reshape(1, 1, 3)


def random_mesh(rng: np.random.Generator, num_triangles: int, size: float) -> TriangleMesh:
    """Triangles of all sizes and directions in a cube about the origin, half of them with varying normals."""
    vertices = rng.uniform(-size, size, (num_triangles, 3, 3))
    normals = rng.normal(size=(num_triangles, 3, 3))
    normals[::2] = normals[::2, :1]  # every second one is flat
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return TriangleMesh(vertices, normals, rng.uniform(0, 1, (num_triangles, 3, 2)))


def triangle(*corners: tuple[float, float, float]) -> TriangleMesh:
    """One triangle whose normals point up."""
    return TriangleMesh(
        np.array([corners], dtype=float), np.broadcast_to([0.0, 0.0, 1.0], (1, 3, 3)), np.zeros((1, 3, 2))
    )
