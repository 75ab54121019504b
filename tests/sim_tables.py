"""Small scenes for tests of the simulation."""

import numpy as np

from openvima.catalog import object_spec
from openvima.catalog.objects import OBJECTS
from openvima.catalog.packs import load_assets
from openvima.scene import FIRST_OBJECT_ID, Action, EndEffector, Placement, Pose, Scene

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


def random_action(rng: np.random.Generator, scene: Scene) -> Action:
    """An action between points on or near bodies, in corners, or anywhere."""

    def point() -> tuple[float, float]:
        kind = rng.integers(4)
        if kind <= 1:
            pose = scene.placements[rng.integers(len(scene.placements))].pose
            return pose.x + float(rng.normal(0, 0.02)), pose.y + float(rng.normal(0, 0.02))
        if kind == 2:
            return float(rng.choice((0.25, 0.75))), float(rng.choice((-0.5, 0.5)))
        return float(rng.uniform(0.25, 0.75)), float(rng.uniform(-0.5, 0.5))

    return Action.planar(point(), point(), float(rng.uniform(-3.1, 3.1)))
