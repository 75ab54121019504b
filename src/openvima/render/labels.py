"""The label raster: which object is topmost at each small square of the table, seen from straight above.

It is privileged knowledge: samplers use it to find free places and the oracle to find points to pick. Rows
run along y and columns along x: with p = 3.125 mm, the centre of the cell in row u and column v is
(0.25 + (v + 0.5) p, −0.5 + (u + 0.5) p).
"""

from collections.abc import Iterable

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.render.indexed import Scratch, indexed, matrix_3x4
from openvima.render.kernels import stamp_triangles
from openvima.scene import WORKSPACE_LOW, Placement, Scene

CELL_M = 0.003125
LABEL_SHAPE = (320, 160)  # y, x
CEILING_M = 0.3  # what is higher is no longer on the table
_ORIGIN = (WORKSPACE_LOW[0] + CELL_M / 2, WORKSPACE_LOW[1] + CELL_M / 2)


def empty_labels() -> tuple[np.ndarray, np.ndarray]:
    """Return the raster of the bare table and its heights, to stamp objects into.

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
        assets: Where its shape comes from.
    """
    mesh = indexed(assets.geometry(placement.object, placement.size, placement.scale).visual)
    x, y, _, _ = placement.pose.quaternion
    is_level = x == 0 and y == 0
    points, selected = Scratch().arrays(mesh)
    stamp_triangles(
        mesh.vertices,
        mesh.upward if is_level else mesh.corners,
        matrix_3x4(placement.pose),
        placement.id,
        _ORIGIN[0],
        _ORIGIN[1],
        CELL_M,
        CEILING_M,
        points,
        selected,
        raster,
        heights,
    )


def label_raster(placements: Scene | Iterable[Placement], assets: Assets) -> np.ndarray:
    """Map the table: the id of the object whose surface is topmost at each cell's centre.

    Args:
        placements: A scene, or its objects.
        assets: Where their shapes come from.

    Returns:
        Shape (320, 160), int16, rows along y and columns along x; 0 where there is no object. Surfaces below
        the sheet or from 0.3 m up do not count.
    """
    raster, heights = empty_labels()
    for placement in placements.placements if isinstance(placements, Scene) else placements:
        stamp(raster, heights, placement, assets)
    return raster


def cell_centres(rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return where cells of the raster lie on the table.

    Args:
        rows: Row indices, shape (...).
        columns: Column indices, shape (...).

    Returns:
        x, y of the cells' centres in metres, shape (..., 2), float64.
    """
    return np.stack(
        [_ORIGIN[0] + np.asarray(columns) * CELL_M, _ORIGIN[1] + np.asarray(rows) * CELL_M], axis=-1
    )
