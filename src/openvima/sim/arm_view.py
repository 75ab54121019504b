"""Meshes of the arm and its tools for videos: tapered tubes for links, joints and tools.

Observations do not show the arm by default; the colours are those of VIMA-Bench's robot.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from openvima.catalog.geometry import TriangleMesh, Vector3
from openvima.render.rasteriser import Drawable
from openvima.scene import EndEffector, Pose
from openvima.sim.ur5 import (
    FLANGE_M,
    FOREARM_M,
    PROBE_BELOW_TIP_M,
    SPATULA_BELOW_TIP_M,
    SPATULA_HALF_SIZE_M,
    TOOL_M,
    UPPER_ARM_M,
    link_frames,
)

_LIGHT = (204, 204, 204)
_DARK = (51, 51, 51)
_TIP = (46, 129, 197)
_NUM_SIDES = 20
_ORIGIN = Pose((0.0, 0.0, 0.0))
_ARM_ID, _TOOL_ID, _HEAD_ID = 2, 3, 4
_Y: Vector3 = (0.0, 1.0, 0.0)
_Z: Vector3 = (0.0, 0.0, 1.0)
_SHOULDER, _UPPER_ARM, _FOREARM, _WRIST_1, _WRIST_2, _WRIST_3, _FLANGE = range(1, 8)  # as in `link_frames`


@dataclass(frozen=True, slots=True)
class _Tube:
    """A tapered cylinder in a link's frame.

    Args:
        link: Index in `link_frames`.
        axis: Unit vector along the tube.
        span: Its ends along the axis, metres.
        radii: Radii at the two ends, metres.
        rgb: Colour.
        id: Segmentation value.
        at: A point of its axis line, metres.
    """

    link: int
    axis: Vector3
    span: tuple[float, float]
    radii: tuple[float, float]
    rgb: tuple[int, int, int] = _LIGHT
    id: int = _ARM_ID
    at: Vector3 = (0.0, 0.0, 0.0)


_ELBOW: Vector3 = (0.0, 0.0, UPPER_ARM_M)
_WRIST: Vector3 = (0.0, 0.0, FOREARM_M)
_ARM_TUBES = (
    _Tube(0, _Z, (0.0, 0.012), (0.082, 0.082), _DARK),
    _Tube(0, _Z, (0.012, 0.035), (0.076, 0.062)),
    _Tube(_SHOULDER, _Z, (-0.056, 0.058), (0.060, 0.060)),
    _Tube(_SHOULDER, _Z, (0.058, 0.066), (0.058, 0.050), _DARK),
    _Tube(_SHOULDER, _Y, (0.0, 0.072), (0.056, 0.056)),
    _Tube(_UPPER_ARM, _Y, (-0.062, 0.056), (0.058, 0.058)),
    _Tube(_UPPER_ARM, _Y, (0.056, 0.066), (0.056, 0.046), _DARK),
    _Tube(_UPPER_ARM, _Z, (0.0, UPPER_ARM_M), (0.044, 0.040)),
    _Tube(_UPPER_ARM, _Y, (-0.062, 0.050), (0.048, 0.048), at=_ELBOW),
    _Tube(_UPPER_ARM, _Y, (0.050, 0.059), (0.046, 0.038), _DARK, at=_ELBOW),
    _Tube(_FOREARM, _Y, (-0.050, 0.056), (0.047, 0.047)),
    _Tube(_FOREARM, _Y, (-0.059, -0.050), (0.038, 0.045), _DARK),
    _Tube(_FOREARM, _Z, (0.0, FOREARM_M), (0.038, 0.031)),
    _Tube(_FOREARM, _Y, (-0.048, 0.040), (0.037, 0.037), at=_WRIST),
    _Tube(_FOREARM, _Y, (-0.056, -0.048), (0.030, 0.036), _DARK, at=_WRIST),
    _Tube(_WRIST_1, _Y, (0.0, 0.128), (0.036, 0.036)),
    _Tube(_WRIST_1, _Y, (0.128, 0.136), (0.035, 0.028), _DARK),
    _Tube(_WRIST_2, _Z, (-0.040, 0.132), (0.036, 0.036)),
    _Tube(_WRIST_2, _Z, (0.132, 0.140), (0.035, 0.028), _DARK),
    _Tube(_WRIST_3, _Y, (0.0, FLANGE_M - 0.012), (0.034, 0.034)),
    _Tube(_WRIST_3, _Y, (FLANGE_M - 0.012, FLANGE_M), (0.032, 0.032), _DARK),
)
_CUP_END_M = TOOL_M + PROBE_BELOW_TIP_M
_SUCTION_TUBES = (
    _Tube(_FLANGE, _Z, (0.0, 0.014), (0.034, 0.034), _DARK, _TOOL_ID),
    _Tube(_FLANGE, _Z, (0.014, 0.070), (0.024, 0.020), _LIGHT, _TOOL_ID),
    _Tube(_FLANGE, _Z, (0.070, 0.104), (0.013, 0.011), _DARK, _HEAD_ID),
    _Tube(_FLANGE, _Z, (0.104, _CUP_END_M), (0.008, 0.014), _TIP, _HEAD_ID),
)
_SPATULA_TUBES = (
    _Tube(_FLANGE, _Z, (0.0, 0.014), (0.034, 0.034), _DARK, _TOOL_ID),
    _Tube(_FLANGE, _Z, (0.014, 0.024), (0.016, 0.012), _DARK, _TOOL_ID),
)


def arm_drawables(joints: np.ndarray, end_effector: EndEffector) -> tuple[Drawable, ...]:
    """Build the arm with its tool, to be drawn with a scene.

    An object that the arm holds is a part of the scene (`World.execute` records it at the tip).

    Args:
        joints: Angles from shoulder pan to wrist 3, shape (6,), radians.
        end_effector: The tool at the flange.

    Returns:
        One body per segmentation value and colour, in world coordinates: the arm has id 2, the gripper's base
        3 and its head 4; the spatula has id 3.

    Raises:
        ShapeError: `joints` does not have shape (6,).
    """
    frames = link_frames(joints)
    return tuple(
        Drawable(_assemble(parts, frames), _ORIGIN, id, rgb) for (id, rgb), parts in _parts(end_effector)
    )


def arm_parts(end_effector: EndEffector) -> tuple[tuple[int, tuple[int, int, int], TriangleMesh], ...]:
    """Return the meshes of the arm with its tool, for viewers that pose them.

    Args:
        end_effector: The tool at the flange.

    Returns:
        Of each part the index of its link in `link_frames`, its colour, and its mesh in the link's frame.
    """
    return tuple((link, rgb, mesh) for (_, rgb), parts in _parts(end_effector) for link, mesh in parts)


_Parts = tuple[tuple[int, TriangleMesh], ...]


@lru_cache(maxsize=2)
def _parts(end_effector: EndEffector) -> tuple[tuple[tuple[int, tuple[int, int, int]], _Parts], ...]:
    """Meshes in link frames, each with its link's index, grouped by segmentation value and colour."""
    groups: dict[tuple[int, tuple[int, int, int]], list[tuple[int, TriangleMesh]]] = {}
    for tube in _ARM_TUBES + (_SUCTION_TUBES if end_effector == "suction" else _SPATULA_TUBES):
        groups.setdefault((tube.id, tube.rgb), []).append((tube.link, _tube_mesh(tube)))
    if end_effector == "spatula":
        groups.setdefault((_TOOL_ID, _TIP), []).append((_FLANGE, _spatula_mesh()))
    return tuple((key, tuple(parts)) for key, parts in groups.items())


def _assemble(parts: _Parts, frames: Sequence[Pose]) -> TriangleMesh:
    """Transform meshes from link frames to the world and join them."""
    vertices = [frames[link].transform(mesh.vertices) for link, mesh in parts]
    rotations = [Pose((0.0, 0.0, 0.0), frame.quaternion) for frame in frames]
    normals = [rotations[link].transform(mesh.normals) for link, mesh in parts]
    return TriangleMesh(
        np.concatenate(vertices), np.concatenate(normals), np.concatenate([mesh.uvs for _, mesh in parts])
    )


def _tube_mesh(tube: _Tube) -> TriangleMesh:
    """Side with smooth normals, ends with flat ones."""
    axis = np.array(tube.axis)
    across = np.roll(axis, 1)  # axes are unit vectors of the frame, so a rolled one is perpendicular
    angles = np.arange(_NUM_SIDES + 1) * (2 * math.pi / _NUM_SIDES)
    ring = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * np.cross(axis, across)
    (start, end), (radius0, radius1) = tube.span, tube.radii
    low = np.array(tube.at) + axis * start + ring * radius0
    high = np.array(tube.at) + axis * end + ring * radius1
    slant = ring + axis * ((radius0 - radius1) / (end - start))
    slant /= np.linalg.norm(slant, axis=1, keepdims=True)
    this, following = slice(None, -1), slice(1, None)
    side = [(low[this], low[following], high[following]), (low[this], high[following], high[this])]
    side_normals = [(slant[this], slant[following], slant[i]) for i in (following, this)]
    start_corner, end_corner = (np.broadcast_to(rim[0], (_NUM_SIDES - 2, 3)) for rim in (low, high))
    caps = [(start_corner, low[2:-1], low[1:-2]), (end_corner, high[1:-2], high[2:-1])]
    cap_normals = [(np.broadcast_to(sign * axis, (_NUM_SIDES - 2, 3)),) * 3 for sign in (-1.0, 1.0)]
    vertices = np.concatenate([np.stack(corners, axis=1) for corners in (*side, *caps)])
    normals = np.concatenate([np.stack(corners, axis=1) for corners in (*side_normals, *cap_normals)])
    return TriangleMesh(vertices, normals, np.zeros((len(vertices), 3, 2)))


def _spatula_mesh() -> TriangleMesh:
    """The spatula below the flange; it sweeps along the flange's y axis."""
    thickness, width, height = SPATULA_HALF_SIZE_M
    centre = np.array([0.0, 0.0, TOOL_M + SPATULA_BELOW_TIP_M - height])
    vertices, normals = [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal, u, v = np.zeros(3), np.zeros(3), np.zeros(3)
            normal[axis], u[(axis + 1) % 3], v[(axis + 2) % 3] = sign, sign, 1.0
            corners = [normal - u - v, normal + u - v, normal + u + v, normal - u + v]
            vertices += [corners[0:3], [corners[0], corners[2], corners[3]]]
            normals += [[normal] * 3] * 2
    scaled = np.array(vertices) * (width, thickness, height) + centre
    return TriangleMesh(scaled, np.array(normals), np.zeros((len(scaled), 3, 2)))
