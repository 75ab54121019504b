"""Small scenes for tests of the simulator and the renderer."""

from functools import lru_cache

import numpy as np

from openvima.catalog import Geometry, TriangleMesh, Vector3, object_spec
from openvima.catalog.bodies import block
from openvima.catalog.objects import OBJECTS
from openvima.catalog.packs import load_assets
from openvima.scene import FIRST_OBJECT_ID, EndEffector, Placement, Pose, Scene

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


ASSETS = load_assets("procedural")
ALL_OBJECTS = tuple(
    name for name in OBJECTS if name not in ("three-sided rectangle", "line", "stand", "disk")
)
Body = tuple[str, float, float, float]  # object, x, y, yaw


def table(*bodies: Body, fixed: tuple[Body, ...] = (), end_effector: EndEffector = "suction") -> Scene:
    """Lay bodies on the table, the fixed ones last; ids count up from the first one of the end effector."""
    first = FIRST_OBJECT_ID[end_effector]
    placements = []
    for index, (name, x, y, yaw_rad) in enumerate((*bodies, *fixed)):
        size = object_spec(name).size_max
        z = ASSETS.geometry(name, size).rest_z_m
        pose = Pose.planar(x, y, yaw_rad, z=z)
        placements.append(Placement(first + index, name, "red", size, pose, fixed=index >= len(bodies)))
    return Scene(tuple(placements), end_effector)


def random_table(rng: np.random.Generator, end_effector: EndEffector) -> Scene:
    """Any bodies anywhere, also inside one another; some fixed."""
    swept = ("small block", "small block", "block", "letter A", "container")
    crowd = swept if end_effector == "spatula" else ALL_OBJECTS
    bodies: list[Body] = [
        (str(name), float(rng.uniform(0.25, 0.75)), float(rng.uniform(-0.5, 0.5)), float(rng.uniform(-3, 3)))
        for name in rng.choice(crowd, size=int(rng.integers(1, 8)))
    ]
    num_free = int(rng.integers(1, len(bodies) + 1))
    return table(*bodies[:num_free], fixed=tuple(bodies[num_free:]), end_effector=end_effector)
