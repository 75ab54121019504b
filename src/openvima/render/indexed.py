"""Meshes in the layout of the kernels: indexed vertices, poses as matrices."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openvima.catalog.geometry import TriangleMesh
from openvima.scene import Pose

MERGE_FROM_TRIANGLES = 400  # below this, merging corners costs more than it saves


@dataclass(frozen=True, slots=True, eq=False)
class IndexedMesh:
    """The triangles of a mesh with shared corners.

    Args:
        vertices: Positions in the body frame, metres, shape (V, 3), float64.
        corners: Triangles as indices into `vertices`, shape (F, 3), int32.
        normals: Unit normals at the corners, shape (F, 3, 3), float64.
        uvs: Texture coordinates at the corners, shape (F, 3, 2), float64.
        is_flat: Whether a triangle's three normals are equal, shape (F,), bool.
        upward: The rows of `corners` that face up while the body is level, shape (U, 3), int32.
    """

    vertices: np.ndarray
    corners: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    is_flat: np.ndarray
    upward: np.ndarray


@lru_cache(maxsize=256)
def indexed(mesh: TriangleMesh) -> IndexedMesh:
    """Return a mesh in indexed form; the same mesh object gives the same arrays."""
    num_triangles = len(mesh.vertices)
    flattened = mesh.vertices.reshape(-1, 3)
    if num_triangles >= MERGE_FROM_TRIANGLES:
        vertices, inverse = np.unique(flattened, axis=0, return_inverse=True)
        corners = inverse.reshape(-1, 3)
    else:
        vertices, corners = flattened, np.arange(3 * num_triangles).reshape(-1, 3)
    a, b, c = (mesh.vertices[:, k, :2] for k in range(3))
    doubled_area = (b - a)[:, 0] * (c - a)[:, 1] - (c - a)[:, 0] * (b - a)[:, 1]
    corners = np.ascontiguousarray(corners, dtype=np.int32)
    # Copies: kernels would be compiled again for the read-only arrays of packs.
    return IndexedMesh(
        vertices=np.array(vertices, dtype=np.float64, order="C"),
        corners=corners,
        normals=np.array(mesh.normals, dtype=np.float64, order="C"),
        uvs=np.array(mesh.uvs, dtype=np.float64, order="C"),
        is_flat=(mesh.normals == mesh.normals[:, :1]).all(axis=(1, 2)),
        upward=np.ascontiguousarray(corners[doubled_area > 0]),
    )


@lru_cache(maxsize=64)
def magnified(mesh: TriangleMesh, factor: float) -> TriangleMesh:
    """Return a mesh scaled by `factor` about its origin."""
    return TriangleMesh(mesh.vertices * factor, mesh.normals, mesh.uvs)


class KernelBuffers:
    """Working memory of the kernels, grown to the largest mesh; not thread-safe."""

    def __init__(self) -> None:
        self._points = np.empty((0, 4))
        self._selected = np.empty(0, dtype=np.int32)

    def arrays(self, mesh: IndexedMesh) -> tuple[np.ndarray, np.ndarray]:
        """Return buffers for vertices, (≥ V, 4) float64, and triangle indices, (≥ F + 1,) int32."""
        if len(mesh.vertices) > len(self._points):
            self._points = np.empty((len(mesh.vertices), 4))
        if len(mesh.corners) >= len(self._selected):
            self._selected = np.empty(len(mesh.corners) + 1, dtype=np.int32)
        return self._points, self._selected


def matrix_3x4(pose: Pose) -> np.ndarray:
    """Return a pose as rotation and translation, shape (3, 4), float64."""
    x, y, z, w = pose.quaternion
    px, py, pz = pose.position
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), px],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), py],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), pz],
        ]
    )
