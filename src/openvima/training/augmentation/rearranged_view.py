"""Second views of scenes for contrastive pretraining: objects rotated, and in half of the scenes swapped."""

import math

import numpy as np

from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Pose, Scene

EDGE_M = 0.06  # from the edge of the workspace to the middle of an object
_JITTER_M = 0.02


def rearranged(scene: Scene, rng: np.random.Generator) -> tuple[Scene, dict[int, float]]:
    """Rotate each object by a random angle; in half of the scenes movable objects also swap positions.

    Returns:
        The scene, and the rotation of each object by id: counter-clockwise seen from above, in 0 … 2π.
    """
    rotations = {p.id: rng.uniform(0, 2 * math.pi) for p in scene.placements}
    movable = [p for p in scene.placements if not p.fixed]
    positions = {p.id: (p.pose.x, p.pose.y) for p in scene.placements}
    if rng.random() < 0.5:
        others = [movable[int(index)].pose for index in rng.permutation(len(movable))]
        positions |= {p.id: _near(other, rng) for p, other in zip(movable, others, strict=True)}
    poses = {
        p.id: Pose((*positions[p.id], p.pose.z), p.pose.rotated(rotations[p.id]).quaternion)
        for p in scene.placements
    }
    return scene.with_poses(poses), rotations


def _near(pose: Pose, rng: np.random.Generator) -> tuple[float, float]:
    """Return a position near another one, inside the workspace."""
    x, y = np.array((pose.x, pose.y)) + rng.uniform(-_JITTER_M, _JITTER_M, 2)
    low, high = np.array(WORKSPACE_LOW) + EDGE_M, np.array(WORKSPACE_HIGH) - EDGE_M
    x, y = np.clip((x, y), low, high).tolist()
    return x, y
