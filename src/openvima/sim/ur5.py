"""Kinematics of the UR5 arm with a vertical tool: forward, and inverse in closed form.

The tip is the point 0.12 m beyond the flange along the tool axis. At tool yaw 0 the tool
frame is Rz(0) · B, where B rotates by π about (−1, 1, 0)/√2: flange x along −y, y along −x, z down.

Source: link lengths of the UR5 data sheet; derivation of the closed form beside `inverse`.
"""

import math

import numpy as np

from openvima.catalog.geometry import Vector3
from openvima.errors import ActionError
from openvima.scene.scene import Pose, Quaternion, multiply, yaw_quaternion

HOME = np.array([-1.0, -0.5, 0.5, -0.5, -0.5, 0.0]) * math.pi
HOME.setflags(write=False)
JOINT_LIMITS = np.array([2.0, 2.0, 1.0, 2.0, 2.0, 2.0]) * math.pi  # rad, both ways
JOINT_LIMITS.setflags(write=False)

SHOULDER_HEIGHT_M = 0.089159
UPPER_ARM_M = 0.425
FOREARM_M = 0.39225
SIDE_OFFSET_M = 0.10915  # of the tool's plane beside the shoulder axis: 0.13585 − 0.1197 + 0.093
WRIST_M = 0.09465
FLANGE_M = 0.0823
TOOL_M = 0.12  # flange to tip
LONGEST_REACH_M = UPPER_ARM_M + FOREARM_M  # 0.81725: elbow straight
SHORTEST_REACH_M = UPPER_ARM_M - FOREARM_M
_HEIGHT_OFFSET_M = TOOL_M + FLANGE_M - SHOULDER_HEIGHT_M

_HALF = math.sqrt(0.5)
_QUARTER_PITCH: Quaternion = (0.0, _HALF, 0.0, _HALF)
_STRAIGHT: Quaternion = (0.0, 0.0, 0.0, 1.0)
# Pose in the parent frame, and index of the joint axis.
_CHAIN: tuple[tuple[Pose, int], ...] = (
    (Pose((0.0, 0.0, SHOULDER_HEIGHT_M), _STRAIGHT), 2),
    (Pose((0.0, 0.13585, 0.0), _QUARTER_PITCH), 1),
    (Pose((0.0, -0.1197, UPPER_ARM_M), _STRAIGHT), 1),
    (Pose((0.0, 0.0, FOREARM_M), _QUARTER_PITCH), 1),
    (Pose((0.0, 0.093, 0.0), _STRAIGHT), 2),
    (Pose((0.0, 0.0, WRIST_M), _STRAIGHT), 1),
)
_WORLD_FROM_BASE = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
_WRIST_FROM_FLANGE = Pose((0.0, FLANGE_M, 0.0), (-_HALF, 0.0, 0.0, _HALF))
_FLANGE_FROM_TIP = Pose((0.0, 0.0, TOOL_M))
_TOOL_DOWN: Quaternion = (-_HALF, _HALF, 0.0, 0.0)


def link_frames(joints: np.ndarray) -> tuple[Pose, ...]:
    """Poses of all links for given joint angles.

    Args:
        joints: Angles from shoulder pan to wrist 3, shape (6,), radians.

    Returns:
        Eight poses in the world: base, shoulder, upper arm, forearm, wrist 1, wrist 2, wrist 3, flange (z
        along the tool).
    """
    frames = [_WORLD_FROM_BASE]
    for (parent_from_joint, axis), angle in zip(_CHAIN, joints.tolist(), strict=True):
        rotation = [0.0, 0.0, 0.0, math.cos(angle / 2)]
        rotation[axis] = math.sin(angle / 2)
        joint = Pose((0.0, 0.0, 0.0), (rotation[0], rotation[1], rotation[2], rotation[3]))
        frames.append(frames[-1] @ parent_from_joint @ joint)
    frames.append(frames[-1] @ _WRIST_FROM_FLANGE)
    return tuple(frames)


def forward(joints: np.ndarray) -> Pose:
    """Pose of the tip for given joint angles, shape (6,), radians; its z axis points along the tool."""
    return link_frames(joints)[-1] @ _FLANGE_FROM_TIP


def tool_pose(x: float, y: float, z: float, yaw_rad: float) -> Pose:
    """Pose of the tip of a vertical tool at a point in metres with a heading."""
    return Pose((x, y, z), multiply(yaw_quaternion(yaw_rad), _TOOL_DOWN))


def inverse(x: float, y: float, z: float, yaw_rad: float) -> np.ndarray:
    """Joint angles for the tip of the vertical tool at a point, elbow up and second wrist joint at −π/2.

    Args:
        x: Metres away from the robot's base.
        y: Metres to its left.
        z: Metres above the table.
        yaw_rad: Heading of the tool.

    Returns:
        Shape (6,), float64, radians; joint 1 in [−3π/2, π/2), joint 6 in [−π, π).

    Raises:
        ActionError: The point is too near, too far or too high; the message names the reach.

    Example:
        >>> inverse(0.5, 0.0, 0.32, 0.0).round(5)[:3]
        array([-3.36166, -1.56815,  1.54739])

    Source: the tool's axis runs in a vertical plane beside the shoulder, so joint 1 follows from the plan
    view and joints 2 and 3 are a triangle of the two arm lengths; joint 4 keeps the tool vertical, joint 6
    sets its heading.
    """
    distance = math.hypot(x, y)
    reach, height = _plane_point(distance, z)
    length = math.hypot(reach, height)
    if not SHORTEST_REACH_M <= length <= LONGEST_REACH_M or reach <= 0:
        raise ActionError(
            f"tip ({x:.4f}, {y:.4f}, {z:.4f}) m needs an arm of {length:.4f} m; it must be "
            f"{SHORTEST_REACH_M:.4f} … {LONGEST_REACH_M:.4f} m with the tool vertical. Lower it or move it "
            f"nearer (`highest_tip_z` gives the limit of the height)."
        )
    # The arm's plane passes the shoulder's axis at a constant side offset, hence the arcsine; `reach` and
    # `height` are the wrist in that plane. The elbow stays up, so one of the two triangles is left out.
    pan = math.atan2(y, x) - math.asin(SIDE_OFFSET_M / distance) - math.pi
    pan = _wrap(pan, -1.5 * math.pi)
    lift = -math.atan2(height, reach) - _corner(UPPER_ARM_M, length, FOREARM_M)
    elbow = math.pi - _corner(UPPER_ARM_M, FOREARM_M, length)
    wrist1 = -math.pi / 2 - lift - elbow
    wrist3 = _wrap(pan + math.pi - yaw_rad, -math.pi)
    return np.array([pan, lift, elbow, wrist1, -math.pi / 2, wrist3])


def highest_tip_z(x: float, y: float) -> float:
    """Greatest height in metres at which the vertical tool reaches above (x, y); −inf where it never does.

    Args:
        x: Metres away from the robot's base.
        y: Metres to its left.
    """
    reach, _ = _plane_point(math.hypot(x, y), 0.0)
    if not 0 < reach <= LONGEST_REACH_M:
        return -math.inf
    return math.sqrt(LONGEST_REACH_M**2 - reach**2) - _HEIGHT_OFFSET_M


def farthest_tip_distance(z: float) -> float:
    """Greatest distance from the base axis at which the vertical tool reaches height `z`; both in metres."""
    height = z + _HEIGHT_OFFSET_M
    return math.hypot(math.sqrt(LONGEST_REACH_M**2 - height**2) + WRIST_M, SIDE_OFFSET_M)


def _plane_point(distance: float, z: float) -> tuple[float, float]:
    """Wrist position in the arm's vertical plane as seen from the shoulder: outward and up, metres."""
    squared = distance * distance - SIDE_OFFSET_M * SIDE_OFFSET_M
    outward = math.sqrt(squared) - WRIST_M if squared > 0 else -math.inf
    return outward, z + _HEIGHT_OFFSET_M


def _corner(a: float, b: float, opposite: float) -> float:
    """Angle between two sides of a triangle."""
    cosine = (a * a + b * b - opposite * opposite) / (2 * a * b)
    return math.acos(max(-1.0, min(1.0, cosine)))


def _wrap(angle: float, low: float) -> float:
    """The equivalent angle in [low, low + 2π)."""
    return (angle - low) % (2 * math.pi) + low


# Dimensions of the two tools, which point down from the flange. Heights are those of the tip (`forward`).
HOVER_TIP_Z_M = 0.32  # above pick and place points
REACH_RESERVE_M = 0.005  # kept below the highest point that the arm can reach

# Suction: a thin probe below the arm's tip.
PROBE_BELOW_TIP_M = 0.003
PROBE_RADIUS_M = 1e-4  # of the lowered shape, nearly a line
CONTACT_RADIUS_M = 0.001  # the probe's true radius: bodies this near to the axis are hit from above
CAPTURE_RADIUS_M = 0.003  # grasp distance above bare floor; 2–4 mm measured in VIMA-Bench
FLANK_RADIUS_M = 0.002  # above a fixed body; VIMA-Bench grasps at 1.2 and 1.7 mm, misses at 2.5 mm

# Spatula: an upright plate, its width across the direction of travel.
SPATULA_HALF_SIZE_M: Vector3 = (0.0025, 0.025, 0.0575)  # along the travel, across it, up
SPATULA_BELOW_TIP_M = 0.005
SWEEP_HOVER_TIP_Z_M = 0.31
SWEEP_TIP_Z_M = 0.005  # leaves 1 mm between the spatula and the floor
SPATULA_RUN_UP_M = 0.02  # the spatula starts this far before pose0 …
SPATULA_SHORTFALL_M = 0.05  # … and stops this far before pose1
COMPAT_SHORTFALL_M = 0.003  # what VIMA-Bench's stop tolerance adds to that
