"""Distance to first contact of a shape that translates along a line.

The distance between two convex shapes is a convex function of the translation of one of them. Newton's
method, started without contact, therefore never overshoots, and converges in a few evaluations.
"""

# pyright: reportAttributeAccessIssue=false
# (MuJoCo's names come from a compiled module without type stubs.)

import math
from collections.abc import Iterable

import mujoco
import numpy as np

from openvima.catalog.geometry import Vector3
from openvima.sim.bodies import Bodies

CONTACT_M = 1e-5  # gaps below this count as contact
_FARTHEST_M = 10.0  # beyond this, distances are not computed
_MOST_STEPS = 50


def gap(bodies: Bodies, geom1: int, geom2: int) -> float:
    """Distance of two convex parts in metres, less their margins; negative if they overlap."""
    reach = bodies.model.geom_margin[geom1] + bodies.model.geom_margin[geom2]
    return mujoco.mj_geomDistance(bodies.model, bodies.data, geom1, geom2, _FARTHEST_M, None) - float(reach)


def body_gap(bodies: Bodies, index1: int, index2: int) -> float:
    """Smallest gap of two bodies in metres; infinite if their bounding circles are apart."""
    reach = bodies.shapes[index1].radius_m + bodies.shapes[index2].radius_m
    if bodies.pose(index1).planar_distance(bodies.pose(index2)) > reach + 0.01:
        return np.inf
    pairs = [(g1, g2) for g1 in bodies.geoms(index1) for g2 in bodies.geoms(index2)]
    return min((gap(bodies, g1, g2) for g1, g2 in pairs), default=np.inf)


def distance_to_contact(
    bodies: Bodies, moving: Iterable[int], others: Iterable[int], *, direction: Vector3, length_m: float
) -> float | None:
    """How far some parts can move before one of them touches one of the others; nothing is moved.

    Args:
        bodies: The bodies, refreshed.
        moving: MuJoCo ids of the parts that move together.
        others: MuJoCo ids of the static parts.
        direction: Unit vector.
        length_m: Largest distance.

    Returns:
        Metres, 0 if they touch already; None without contact.
    """
    ways = [
        way
        for geom in moving
        for other in others
        if (way := _pair_distance_to_contact(bodies, geom, other, np.array(direction), length_m)) is not None
    ]
    return min(ways, default=None)


def _pair_distance_to_contact(
    bodies: Bodies, geom: int, other: int, direction: np.ndarray, length_m: float
) -> float | None:
    model, positions = bodies.model, bodies.data.geom_xpos
    margin = float(model.geom_margin[geom] + model.geom_margin[other])
    start = positions[geom].copy()
    offset = positions[other] - start
    sideways = offset - direction * _dot(offset, direction)
    if _dot(sideways, sideways) > float(model.geom_rbound[geom] + model.geom_rbound[other] + margin) ** 2:
        return None
    segment = np.zeros(6)
    way = 0.0
    found = None
    for _ in range(_MOST_STEPS):
        positions[geom] = start + way * direction
        distance = mujoco.mj_geomDistance(model, bodies.data, geom, other, _FARTHEST_M, segment) - margin
        if distance < CONTACT_M:
            found = way
            break
        towards = segment[3:] - segment[:3]
        closing = _dot(towards, direction) / math.hypot(*towards.tolist())
        if closing <= 1e-6:  # the nearest points no longer approach each other: a miss
            break
        way += distance / closing
        if way > length_m:
            break
    positions[geom] = start
    return found


def _dot(a: np.ndarray, b: np.ndarray) -> float:
    """Scalar product, written out: the last bits of NumPy's depend on the CPU."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return ax * bx + ay * by + az * bz
