"""Problems of tasks under the hands of a test: their pictures, steps, random actions."""

import numpy as np

from openvima.scene import (
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    Outcome,
    Placement,
    Pose,
    Problem,
    Scene,
    SceneImage,
)
from openvima.tasks import Progress, advance, begin


def pictured(problem: Problem) -> tuple[Placement, ...]:
    """What the only image of the prompt, a scene, shows."""
    ((name, image),) = problem.prompt.images
    assert name == "scene" and isinstance(image, SceneImage)
    return image.scene.placements


def played(problem: Problem, *moves: dict[int, Pose]) -> list[Outcome]:
    """Outcome after each step."""
    progress, scene, outcomes = begin(problem), problem.scene, []
    for move in moves:
        scene = scene.with_poses(move)
        progress, outcome = advance(problem, progress, scene)
        outcomes.append(outcome)
    return outcomes


def judged(problem: Problem, *steps: dict[int, Pose]) -> tuple[Progress, Outcome]:
    """How the problem stands after steps that move objects to these poses and leave the others."""
    progress, outcome, scene = begin(problem), Outcome(), problem.scene
    for step in steps:
        assert not outcome.is_over, outcome.reason
        scene = scene.with_poses(step)
        progress, outcome = advance(problem, progress, scene)
    return progress, outcome


def random_action(rng: np.random.Generator, scene: Scene) -> dict[str, np.ndarray]:
    """Draw a valid action: anywhere, from an object, or from an object onto an object."""
    low, high = np.array(WORKSPACE_LOW), np.array(WORKSPACE_HIGH)
    points = rng.uniform(low, high, size=(2, 2))
    for row in range(rng.integers(3)):
        placement = scene.placements[rng.integers(len(scene.placements))]
        points[row] = np.clip(placement.pose.position[:2] + rng.normal(0, 0.02, 2), low, high)
    turns = rng.uniform(-1, 1, size=(2, 4)) * (rng.random() < 0.9)
    # Rounding to float32 may leave the table by the last bit.
    points = np.clip(points.astype(np.float32), low.astype(np.float32), high.astype(np.float32))
    return {
        f"pose{i}_{name}": value
        for i, pose in enumerate(zip(points, turns.astype(np.float32), strict=True))
        for name, value in zip(("position", "rotation"), pose, strict=True)
    }
