"""The label raster: the topmost object in each cell of the table, from straight above.

Privileged information: samplers find free poses with it, and the oracle points to pick. Rows are along y and
columns along x: with p = 3.125 mm, the centre of the cell in row u and column v is
(0.25 + (v + 0.5) p, −0.5 + (u + 0.5) p).
"""

from collections.abc import Iterable

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.render.kernels import index_mesh, matrix_3x4, stamp_triangles
from openvima.scene import WORKSPACE_LOW, Placement, Scene

CELL_M = 0.003125
LABEL_SHAPE = (320, 160)  # y, x
CEILING_M = 0.3  # surfaces above are ignored
_ORIGIN = (WORKSPACE_LOW[0] + CELL_M / 2, WORKSPACE_LOW[1] + CELL_M / 2)


def empty_labels() -> tuple[np.ndarray, np.ndarray]:
    """Return the label raster and heights of an empty table.

    Returns:
        Labels, int16, all 0, and heights in metres, float32, all 0 (the sheet); both of shape (320, 160).
    """
    return np.zeros(LABEL_SHAPE, dtype=np.int16), np.zeros(LABEL_SHAPE, dtype=np.float32)


def stamp(raster: np.ndarray, heights: np.ndarray, placement: Placement, assets: Assets) -> None:
    """Add one object to a label raster, in place.

    Args:
        raster: Labels, shape (320, 160), int16; cells where the object is topmost become its id.
        heights: Height of the topmost surface in metres, shape (320, 160), float32; raised there.
        placement: The object.
        assets: Asset pack.
    """
    mesh = index_mesh(placement.geometry(assets).visual)
    x, y, _, _ = placement.pose.quaternion
    is_level = x == 0 and y == 0
    stamp_triangles(
        mesh.vertices,
        mesh.upward if is_level else mesh.corners,
        matrix_3x4(placement.pose),
        placement.id,
        *_ORIGIN,
        CELL_M,
        CEILING_M,
        raster,
        heights,
    )


def label_raster(placements: Scene | Iterable[Placement], assets: Assets) -> np.ndarray:
    """Return the id of the topmost object at each cell's centre.

    Args:
        placements: A scene, or its objects.
        assets: Asset pack.

    Returns:
        Shape (320, 160), int16, rows along y and columns along x; 0 without an object. Surfaces below
        the sheet or above 0.3 m are ignored.
    """
    raster, heights = empty_labels()
    for placement in placements.placements if isinstance(placements, Scene) else placements:
        stamp(raster, heights, placement, assets)
    return raster


def cell_centres(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the positions of cells on the table.

    Args:
        rows: Row indices, shape (...).
        columns: Column indices, shape (...).

    Returns:
        x, y of the cells' centres in metres, shape (..., 2), float64.
    """
    return np.stack([columns, rows], axis=-1) * CELL_M + _ORIGIN
