"""The two bodies of the towers of Hanoi: a stand with three rods, and a disk with a hole.

No task of the benchmark uses them.
"""

import math

import numpy as np

from openvima.catalog.boxes import Box, box_mesh
from openvima.catalog.geometry import CollisionHull, Geometry, TriangleMesh, Vector3
from openvima.catalog.meshes import combined, draped, prism, revolved, slab_hull
from openvima.catalog.outlines import rectangle, regular_polygon

_PLATE_M, _PLATE_THICKNESS_M = 0.18, 0.01
_ROD_RADIUS_M, _ROD_TOP_Z, _ROD_SIDES = 0.007, 0.105, 12
_ROD_TEXTURE_PER_M = 3.5
_DISK_RADIUS_M, _HOLE_RADIUS_M, _DISK_HALF_HEIGHT_M, _DISK_PARTS = 0.045, 0.0225, 0.015, 12
LONG_RODS_Z = -0.045
"""Lower end of the rods in the original pack, where they reach through the plates."""


def hanoi_stand(rod_low_z: float = -_PLATE_THICKNESS_M / 2) -> Geometry:
    """Return three plates in a row along y, each with a rod in its middle; origin in the middle plate.

    Args:
        rod_low_z: Where the rods begin, metres; by default at the lower faces of the plates.
    """
    half, middles = _PLATE_THICKNESS_M / 2, (-_PLATE_M, 0.0, _PLATE_M)
    plates = [Box((_PLATE_M, _PLATE_M, _PLATE_THICKNESS_M), (0.0, y, 0.0)) for y in middles]
    rod = _rod(rod_low_z, _ROD_TOP_Z)
    visual = combined([draped(box_mesh(plates)), *(_moved(rod, (0.0, y, 0.0)) for y in middles)])
    plate = np.array(rectangle((0.0, 0.0), (_PLATE_M / 2, _PLATE_M / 2)))
    circle = np.array(regular_polygon(_ROD_SIDES, _ROD_RADIUS_M))
    hulls = [slab_hull(plate + np.array((0.0, y)), -half, half) for y in middles]
    hulls += [slab_hull(circle + np.array((0.0, y)), rod_low_z, _ROD_TOP_Z) for y in middles]
    return Geometry(visual, tuple(hulls), rest_z_m=-min(rod_low_z, -half))


def hanoi_disk() -> Geometry:
    """Return a flat ring, origin at its centre; what collides is open in the middle, too."""
    low, high = -_DISK_HALF_HEIGHT_M, _DISK_HALF_HEIGHT_M
    outer = np.round(regular_polygon(32, _DISK_RADIUS_M), 6)
    inner = np.round(regular_polygon(16, _HOLE_RADIUS_M), 6)
    return Geometry(prism([outer, inner[::-1]], low, high), _ring_parts(low, high), rest_z_m=high)


def _ring_parts(low: float, high: float) -> tuple[CollisionHull, ...]:
    angles = 2 * math.pi * np.arange(_DISK_PARTS + 1) / _DISK_PARTS
    around = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 9)
    sectors = (
        np.concatenate([_HOLE_RADIUS_M * around[i : i + 2], _DISK_RADIUS_M * around[i : i + 2]])
        for i in range(_DISK_PARTS)
    )
    return tuple(slab_hull(sector, low, high) for sector in sectors)


def _rod(low: float, high: float) -> TriangleMesh:
    """An upright rod about the z axis with sharp edges."""
    radius = _ROD_RADIUS_M
    sides = ((0.0, low), (radius, low)), ((radius, low), (radius, high)), ((radius, high), (0.0, high))
    distances = (0.0, radius), (radius + high - max(low, 0.0), radius), (radius, 0.0)
    return combined(
        [
            revolved(side, _ROD_SIDES, texture_radii=[_ROD_TEXTURE_PER_M * d for d in distance])
            for side, distance in zip(sides, distances, strict=True)
        ]
    )


def _moved(mesh: TriangleMesh, offset: Vector3) -> TriangleMesh:
    return TriangleMesh(mesh.vertices + np.array(offset), mesh.normals, mesh.uvs)
