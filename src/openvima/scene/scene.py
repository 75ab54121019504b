"""Rigid poses, and scenes: catalogue objects with texture, size and pose."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from openvima.catalog.geometry import Assets, Geometry, Vector3
from openvima.errors import SceneError, brief_repr

Point = tuple[float, float]  # x and y on the table, metres
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Pose:
    """A rigid transform, world frame unless the name says otherwise.

    `a @ b` composes transforms like matrices: `world_from_tool = world_from_base @ base_from_tool`.

    Args:
        position: x (away from the robot), y (to its left), z (up), in metres.
        quaternion: Unit quaternion, order x, y, z, w.
    """

    position: Vector3
    quaternion: Quaternion = IDENTITY

    @staticmethod
    def planar(x: float, y: float, yaw_rad: float = 0.0, *, z: float = 0.0) -> "Pose":
        """Build the pose of a flat object, rotated by `yaw_rad` about the world's z axis."""
        return Pose((float(x), float(y), float(z)), yaw_quaternion(yaw_rad))

    @property
    def x(self) -> float:
        """Metres away from the robot."""
        return self.position[0]

    @property
    def y(self) -> float:
        """Metres to the robot's left."""
        return self.position[1]

    @property
    def z(self) -> float:
        """Metres above the table."""
        return self.position[2]

    @property
    def yaw_rad(self) -> float:
        """Heading in (−π, π].

        Source: angle about z of the z-x-y static Euler angles, R = Ry Rx Rz; the usual yaw for flat bodies.
        """
        x, y, z, w = self.quaternion
        return math.atan2(2 * (x * y + w * z), 1 - 2 * (x * x + z * z))

    def rotated(self, yaw_rad: float) -> "Pose":
        """Return this pose rotated in place by `yaw_rad` about the world's z axis."""
        return Pose(self.position, multiply(yaw_quaternion(yaw_rad), self.quaternion))

    def moved(self, dx: float = 0.0, dy: float = 0.0, dz: float = 0.0) -> "Pose":
        """Return this pose translated by metres in the world frame."""
        return Pose((self.x + dx, self.y + dy, self.z + dz), self.quaternion)

    def planar_distance(self, other: "Pose") -> float:
        """Distance of the two positions in the table's plane, in metres."""
        return math.hypot(self.x - other.x, self.y - other.y)

    def __matmul__(self, other: "Pose") -> "Pose":
        ox, oy, oz = rotate(self.quaternion, other.position)
        position = (self.x + ox, self.y + oy, self.z + oz)
        return Pose(position, multiply(self.quaternion, other.quaternion))

    def inverse(self) -> "Pose":
        """Return the inverse: `pose @ pose.inverse()` is the identity."""
        x, y, z, w = self.quaternion
        conjugate = (-x, -y, -z, w)
        px, py, pz = rotate(conjugate, self.position)
        return Pose((-px, -py, -pz), conjugate)

    def matrix(self) -> np.ndarray:
        """Rotation matrix, shape (3, 3), float64; columns are the body's axes in the world."""
        x, y, z, w = self.quaternion
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )

    def transform(self, points: np.ndarray) -> np.ndarray:
        """Transform points from this frame to the parent frame; shape (..., 3) to (..., 3), metres."""
        points = np.asarray(points, dtype=np.float64)
        along_x, along_y, along_z = self.matrix().T
        # Written out: the last bits of a matrix product depend on the CPU.
        rotated = points[..., :1] * along_x + points[..., 1:2] * along_y + points[..., 2:] * along_z
        return rotated + np.asarray(self.position)


def yaw_quaternion(yaw_rad: float) -> Quaternion:
    """Quaternion xyzw of a rotation by `yaw_rad` about z."""
    return (0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def normalised(quaternion: Quaternion) -> Quaternion:
    """Scale a quaternion to unit length.

    Raises:
        SceneError: The quaternion has length 0 or is not finite.
    """
    length = math.sqrt(sum(c * c for c in quaternion))
    if not length > 0 or not math.isfinite(length):
        raise SceneError(f"quaternion {quaternion} has no direction; give one of finite length above 0.")
    x, y, z, w = quaternion
    return (x / length, y / length, z / length, w / length)


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product of two quaternions xyzw: first rotate by `b`, then by `a`."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def rotate(quaternion: Quaternion, vector: Vector3) -> Vector3:
    """Rotate a vector by a unit quaternion xyzw."""
    qx, qy, qz, qw = quaternion
    vx, vy, vz = vector
    tx, ty, tz = 2 * (qy * vz - qz * vy), 2 * (qz * vx - qx * vz), 2 * (qx * vy - qy * vx)
    return (
        vx + qw * tx + qy * tz - qz * ty,
        vy + qw * ty + qz * tx - qx * tz,
        vz + qw * tz + qx * ty - qy * tx,
    )


def angle_difference(a_rad: float, b_rad: float, period_rad: float = 2 * math.pi) -> float:
    """Smallest absolute difference of two angles modulo `period_rad`, in radians.

    Args:
        a_rad: One angle.
        b_rad: The other angle.
        period_rad: Angle of rotational symmetry; 0: full symmetry, so the difference is 0.
    """
    if period_rad == 0:
        return 0.0
    difference = abs(a_rad - b_rad) % period_rad
    return min(difference, period_rad - difference)


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
        return replace(self, pose=pose)

    def geometry(self, assets: Assets) -> Geometry:
        """Return its shape in an asset pack, in the link frame."""
        return assets.geometry(self.object, self.size, self.scale)


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
