"""Rays against the objects on the table: what a click, or a look from above, meets first."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from openvima.catalog.geometry import Assets
from openvima.scene import Placement

TABLE = 0  # object id of the table itself
_ABOVE_M = 1.0
_SMALLEST = 1e-12


@dataclass(frozen=True, slots=True)
class Hit:
    """Where a ray ends.

    Args:
        object_id: Id of the object; 0 for the table.
        point: x, y, z in metres.
    """

    object_id: int
    point: tuple[float, float, float]


def first_hit(
    placements: Iterable[Placement],
    origin: Sequence[float],
    direction: Sequence[float],
    assets: Assets,
) -> Hit | None:
    """Return the first thing that a ray hits: an object, or else the plane of the table at z = 0.

    Args:
        placements: The objects.
        origin: Start of the ray in metres, shape (3,).
        direction: Its direction, of any length above 0, shape (3,).
        assets: Asset pack.

    Returns:
        The hit; None if the ray meets no object and leads away from the table.
    """
    start, ray = np.asarray(origin, float), np.asarray(direction, float)
    nearest, object_id = -start[2] / ray[2] if ray[2] else np.inf, TABLE
    if nearest < 0:
        nearest = np.inf
    for placement in placements:
        visual = placement.geometry(assets).visual
        corners = placement.pose.transform(visual.vertices.reshape(-1, 3)).reshape(-1, 3, 3)
        distance = _nearest(corners, start, ray)
        if distance < nearest:
            nearest, object_id = distance, placement.id
    if not np.isfinite(nearest):
        return None
    x, y, z = (start + nearest * ray).tolist()
    return Hit(object_id, (x, y, z))


def object_below(placements: Iterable[Placement], point: tuple[float, float], assets: Assets) -> int:
    """Return the id of the topmost object at a point of the table; 0 if there is none.

    Args:
        placements: The objects.
        point: x, y in metres.
        assets: Asset pack.
    """
    hit = first_hit(placements, (*point, _ABOVE_M), (0.0, 0.0, -1.0), assets)
    return TABLE if hit is None else hit.object_id


def _nearest(triangles: np.ndarray, start: np.ndarray, ray: np.ndarray) -> float:
    """Smallest multiple of a ray that meets a triangle, shape (N, 3, 3); infinite without any.

    Möller and Trumbore, "Fast, minimum storage ray-triangle intersection", 1997; both sides count.
    """
    first = triangles[:, 0]
    edge1, edge2 = triangles[:, 1] - first, triangles[:, 2] - first
    across = np.cross(ray, edge2)
    det = (edge1 * across).sum(axis=1)
    crossed = np.abs(det) > _SMALLEST
    inverse = 1 / np.where(crossed, det, 1.0)
    offset = start - first
    u = (offset * across).sum(axis=1) * inverse
    normal = np.cross(offset, edge1)
    v = normal @ ray * inverse
    distance = (edge2 * normal).sum(axis=1) * inverse
    met = crossed & (u >= 0) & (v >= 0) & (u + v <= 1) & (distance > 0)
    return float(distance[met].min(initial=np.inf))
