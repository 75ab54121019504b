"""Meshes of the arm and its tools for videos, from `arm.npz`: tapered tubes for links, joints and tools.

Observations do not show the arm by default; the colours are those of VIMA-Bench's robot.
"""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from openvima.catalog.geometry import TriangleMesh
from openvima.render.rasteriser import Drawable
from openvima.scene import EndEffector, Pose
from openvima.sim.ur5 import link_frames

_ORIGIN = Pose((0.0, 0.0, 0.0))


def arm_drawables(joints: np.ndarray, end_effector: EndEffector) -> tuple[Drawable, ...]:
    """Build the arm with its tool, to be drawn with a scene.

    An object that the arm holds is a part of the scene (`World.execute` records it at the tip).

    Args:
        joints: Angles from shoulder pan to wrist 3, shape (6,), radians.
        end_effector: The tool at the flange.

    Returns:
        One body per segmentation value and colour, in world coordinates: the arm has id 2, the gripper's base
        3 and its head 4; the spatula has id 3.
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
    """Load meshes in link frames, each with its link's index, grouped by segmentation value and colour.

    Of each tool `arm.npz` has `parts`, (P, 6): link, segmentation value, colour and number of triangles; and
    `corners`, (F, 3, 6): position and normal of each corner.
    """
    with np.load(Path(__file__).with_name("arm.npz")) as file:
        parts, corners = file[f"{end_effector}/parts"], file[f"{end_effector}/corners"]
    groups: dict[tuple[int, tuple[int, int, int]], list[tuple[int, TriangleMesh]]] = {}
    meshes = np.split(corners, np.cumsum(parts[:-1, 5]))
    for (link, id, red, green, blue, count), mesh in zip(parts.tolist(), meshes, strict=True):
        vertices, normals = (np.ascontiguousarray(half) for half in np.split(mesh, 2, axis=2))
        part = TriangleMesh(vertices, normals, np.zeros((count, 3, 2)))
        groups.setdefault((id, (red, green, blue)), []).append((link, part))
    return tuple((key, tuple(group)) for key, group in groups.items())


def _assemble(parts: _Parts, frames: Sequence[Pose]) -> TriangleMesh:
    """Transform meshes from link frames to the world and join them."""
    vertices = [frames[link].transform(mesh.vertices) for link, mesh in parts]
    rotations = [Pose((0.0, 0.0, 0.0), frame.quaternion) for frame in frames]
    normals = [rotations[link].transform(mesh.normals) for link, mesh in parts]
    return TriangleMesh(
        np.concatenate(vertices), np.concatenate(normals), np.concatenate([mesh.uvs for _, mesh in parts])
    )
