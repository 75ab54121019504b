"""Scenes: catalogue objects with texture, size and pose."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from openvima.catalog.geometry import Vector3
from openvima.errors import SceneError, brief_repr
from openvima.scene.pose import Pose

EndEffector = Literal["suction", "spatula"]

WORKSPACE_LOW = (0.25, -0.5)  # m, x and y, inclusive
WORKSPACE_HIGH = (0.75, 0.5)
BACKGROUND_ID = 255  # segmentation value of empty pixels
FLOOR_ID = 0
SHEET_ID = 1
FIRST_OBJECT_ID: dict[EndEffector, int] = {"suction": 5, "spatula": 4}  # below: floor, sheet, arm, tool
END_EFFECTORS: tuple[EndEffector, EndEffector] = ("suction", "spatula")  # index = the observation's `ee`


@dataclass(frozen=True, slots=True)
class Placement:
    """One object of a scene.

    Args:
        id: Value of its pixels in segmentation images, unique in the scene.
        object: Display name in the catalogue, such as "letter A".
        texture: Display name in the catalogue, such as "red swirl", or "gray" in neutral prompt images.
        size: Sampled nominal size (x, y, z) in metres, task scale not included.
        pose: Pose of the object's link frame (mesh origin) in the world.
        fixed: Fixed to the table: it collides but cannot be lifted or pushed.
        scale: Factor per axis that a task applies on top of the size.
    """

    id: int
    object: str
    texture: str
    size: Vector3
    pose: Pose
    fixed: bool = False
    scale: Vector3 = (1.0, 1.0, 1.0)

    def at(self, pose: Pose) -> "Placement":
        """Return the same object at another pose."""
        return Placement(self.id, self.object, self.texture, self.size, pose, self.fixed, self.scale)


@dataclass(frozen=True, slots=True)
class Scene:
    """All objects on the table, in the order of their ids, and the end effector.

    Args:
        placements: The objects; ids ascend.
        end_effector: "suction" or "spatula".
    """

    placements: tuple[Placement, ...]
    end_effector: EndEffector = "suction"

    __repr__ = brief_repr

    def __post_init__(self) -> None:
        ids = [placement.id for placement in self.placements]
        if ids != sorted(set(ids)):
            raise SceneError(f"object ids {ids} must be distinct and ascending.")

    def __getitem__(self, object_id: int) -> Placement:
        for placement in self.placements:
            if placement.id == object_id:
                return placement
        raise SceneError(f"no object has id {object_id}; the scene holds {[p.id for p in self.placements]}.")

    def describe(self, object_id: int) -> str:
        """Name an object for a reason or an error, such as "object 6 (red letter A)"."""
        placement = self[object_id]
        return f"object {object_id} ({placement.texture} {placement.object})"

    def with_poses(self, poses: Mapping[int, Pose]) -> "Scene":
        """Return the scene with some objects moved; `poses` maps object ids to new link-frame poses."""
        moved = tuple(p.at(poses[p.id]) if p.id in poses else p for p in self.placements)
        return Scene(moved, self.end_effector)


def in_workspace(pose: Pose) -> bool:
    """Whether the pose's planar position is in the closed workspace rectangle."""
    return WORKSPACE_LOW[0] <= pose.x <= WORKSPACE_HIGH[0] and WORKSPACE_LOW[1] <= pose.y <= WORKSPACE_HIGH[1]
