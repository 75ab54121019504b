"""Meshes of the arm and its tools for videos, from `arm.npz`: tapered tubes for links, joints and tools.

Observations do not show the arm by default; the colours are those of VIMA-Bench's robot.
"""

from functools import lru_cache
from pathlib import Path

import numpy as np

from openvima.catalog.geometry import TriangleMesh
from openvima.catalog.meshes import combine
from openvima.render.rasteriser import Drawable, Rgb
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
    bodies: dict[tuple[int, Rgb], list[TriangleMesh]] = {}
    for link, id, rgb, mesh in arm_parts(end_effector):
        rotation = Pose((0.0, 0.0, 0.0), frames[link].quaternion)
        normals = rotation.transform(mesh.normals)
        posed = TriangleMesh(frames[link].transform(mesh.vertices), normals, mesh.uvs)
        bodies.setdefault((id, rgb), []).append(posed)
    return tuple(Drawable(combine(parts), _ORIGIN, id, rgb) for (id, rgb), parts in bodies.items())


@lru_cache(maxsize=2)
def arm_parts(end_effector: EndEffector) -> tuple[tuple[int, int, Rgb, TriangleMesh], ...]:
    """Return the meshes of the arm with its tool, in the frames of their links.

    Of each tool `arm.npz` has `parts`, (P, 6): link, segmentation value, colour and number of triangles; and
    `corners`, (F, 3, 6): position and normal of each corner.

    Args:
        end_effector: The tool at the flange.

    Returns:
        Of each part the index of its link in `link_frames`, segmentation value, colour and mesh.
    """
    with np.load(Path(__file__).with_name("arm.npz")) as file:
        parts, corners = file[f"{end_effector}/parts"], file[f"{end_effector}/corners"]
    found = []
    meshes = np.split(corners, np.cumsum(parts[:-1, 5]))
    for (link, id, red, green, blue, count), mesh in zip(parts.tolist(), meshes, strict=True):
        vertices, normals = (np.ascontiguousarray(half) for half in np.split(mesh, 2, axis=2))
        part = TriangleMesh(vertices, normals, np.zeros((count, 3, 2)))
        found.append((link, id, (red, green, blue), part))
    return tuple(found)
