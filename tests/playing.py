"""Problems of tasks under the hands of a test: what they picture, and how they stand after steps."""

from openvima.scene import Outcome, Placement, Pose, Problem, SceneImage
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
