"""Cases for tests of tasks: problems, steps, frequencies, random actions, and their whole content as text."""

import collections
import math
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from openvima.render.camera import VIEWS
from openvima.scene import (
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
    AtPose,
    DistractorsApart,
    Outcome,
    Placement,
    Pose,
    Problem,
    Scene,
    SceneImage,
    in_workspace,
)
from openvima.tasks import Progress, advance, begin

# One of each kind of prompt, goal and tool. The whole registry is tested by `env/test_tabletop.py`,
# `tasks/test_oracle_end_to_end.py` and the digests.
REPRESENTATIVE_TASKS = (
    *("rotate", "visual_manipulation", "rearrange", "follow_order", "novel_adj_and_noun", "twist"),
    *("same_shape", "pick_in_order_then_restore", "sweep_without_touching", "gather_then_put"),
)


def roles(problem: Problem) -> tuple[Placement, Placement, list[Placement]]:
    """Target, base and distractors."""
    (goal,) = problem.goals
    (constraint,) = problem.constraints
    assert isinstance(goal, AtPose) and goal.relative_to is not None
    assert isinstance(constraint, DistractorsApart)
    scene = problem.scene
    return scene[goal.object_id], scene[goal.relative_to], [scene[i] for i in constraint.object_ids]


def roles_with_twins(problem: Problem) -> tuple[Placement, Placement, Placement, list[Placement]]:
    """Target, base, the other object of the target's shape, and the rest."""
    target, base, distractors = roles(problem)
    (twin,) = [distractor for distractor in distractors if distractor.object == target.object]
    return target, base, twin, [distractor for distractor in distractors if distractor is not twin]


def judge_step(problem: Problem, moved: dict[int, Pose]) -> Outcome:
    """Outcome of a first step that leaves these objects there."""
    return judged(problem, moved)[1]


def moves(problem: Problem) -> list[dict[int, Pose]]:
    """One step for each goal, in order."""
    return [{goal.object_id: goal.target} for goal in problem.goals if isinstance(goal, AtPose)]


def beside(problem: Problem, anchor: Pose, distance_m: float, *, moved_id: int) -> Pose:
    """The pose at a distance from another that is farthest from all objects but the one to be moved there."""
    angles = [math.radians(degrees) for degrees in range(360)]
    poses = [anchor.moved(distance_m * math.cos(angle), distance_m * math.sin(angle)) for angle in angles]
    others = [p.pose for p in problem.scene.placements if p.id != moved_id and p.pose != anchor]
    return max(filter(in_workspace, poses), key=lambda pose: min(map(pose.planar_distance, others)))


def assert_judged_at_its_limits(problem: Problem) -> None:
    """Both sides of every limit, for the target and for each distractor."""
    target, base, distractors = roles(problem)
    near, far = (beside(problem, base.pose, d, moved_id=target.id) for d in (0.099, 0.101))
    assert judge_step(problem, {}) == Outcome()
    assert judge_step(problem, {target.id: near.rotated(2.0).moved(dz=0.1)}).success  # any heading and height
    assert judge_step(problem, {target.id: far}) == Outcome()
    outside = [Pose.planar(0.751, y) for y in (-0.4, -0.2, 0.0, 0.2, 0.4)]
    lost_at = max(outside, key=lambda pose: min(pose.planar_distance(d.pose) for d in distractors))
    lost = judge_step(problem, {target.id: lost_at})
    assert lost.failure and "left the workspace" in lost.reason, lost
    for distractor in distractors:
        near, far = (beside(problem, base.pose, d, moved_id=distractor.id) for d in (0.099, 0.101))
        assert "of the target of" in judge_step(problem, {distractor.id: near}).reason
        assert judge_step(problem, {distractor.id: near}).failure
        assert judge_step(problem, {distractor.id: far}) == Outcome()
        touching = beside(problem, target.pose, 0.09, moved_id=distractor.id)
        assert judge_step(problem, {distractor.id: touching}).failure
        both = {target.id: base.pose, distractor.id: near}
        assert judge_step(problem, both).failure  # what is spoilt counts before what is reached
        assert not judge_step(problem, {distractor.id: Pose.planar(0.9, 0.0)}).failure


def group_roles(problem: Problem) -> tuple[Placement, list[Placement], list[Placement]]:
    """Base, objects that belong into it, distractors."""
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    (constraint,) = problem.constraints
    (base_id,) = {goal.relative_to for goal in goals}
    assert isinstance(constraint, DistractorsApart) and base_id is not None
    scene = problem.scene
    dragged = [scene[goal.object_id] for goal in goals]
    assert all(goal.target == scene[base_id].pose for goal in goals)
    return scene[base_id], dragged, [scene[object_id] for object_id in constraint.object_ids]


def tolerance_m(problem: Problem) -> float:
    """The distance from the base's origin that all goals allow."""
    (tolerance,) = {goal.tolerance for goal in problem.goals if isinstance(goal, AtPose)}
    assert tolerance.yaw_rad is None
    return tolerance.position_m


_QUANTILE = 3.09  # of the normal distribution at p = 0.001


def assert_frequencies(drawn: Iterable[Hashable], shares: Mapping[Hashable, float]) -> None:
    """Check that values were drawn with the given chances, and no others."""
    counts = collections.Counter(drawn)
    assert set(counts) <= set(shares), f"also drawn: {set(counts) - set(shares)}"
    total = counts.total()
    statistic = sum((counts[value] - total * share) ** 2 / (total * share) for value, share in shares.items())
    assert statistic < _critical(len(shares) - 1), (statistic, dict(counts))


def assert_uniform(drawn: Iterable[Hashable], options: Iterable[Hashable]) -> None:
    """Check that values were drawn with equal chances from the options."""
    options = list(options)
    assert_frequencies(drawn, dict.fromkeys(options, 1 / len(options)))


def _critical(degrees: int) -> float:
    """Value that a chi-square statistic exceeds once in a thousand times (Wilson and Hilferty, 1931)."""
    spread = 2 / (9 * degrees)
    return degrees * (1 - spread + _QUANTILE * spread**0.5) ** 3


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


def frozen(value: Any) -> Any:
    """A nested observation, info or result as something that `==` compares byte by byte."""
    if isinstance(value, dict):
        return {key: frozen(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [frozen(entry) for entry in value]
    if is_dataclass(value):
        return [frozen(getattr(value, field.name)) for field in fields(value) if field.compare]
    if isinstance(value, np.ndarray) and value.dtype != object:
        return value.shape, value.dtype.str, value.tobytes()
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def full_repr(value: Any) -> str:
    """Return what the `__repr__` that dataclasses generate returns; those of the package are brief."""
    kind = type(value)
    if kind is tuple:
        items = [full_repr(item) for item in value]
        return f"({items[0]},)" if len(items) == 1 else f"({', '.join(items)})"
    if kind is list:
        return f"[{', '.join(map(full_repr, value))}]"
    if kind is dict:
        return f"{{{', '.join(f'{key!r}: {full_repr(item)}' for key, item in value.items())}}}"
    if is_dataclass(value) and not isinstance(value, type):
        parts = (
            f"{field.name}={full_repr(getattr(value, field.name))}" for field in fields(value) if field.repr
        )
        return f"{type(value).__qualname__}({', '.join(parts)})"
    return repr(value)


def noise(seed: int = 0) -> dict[str, np.ndarray]:
    """A picture of each view in which every pixel is drawn."""
    rng = np.random.default_rng(seed)
    return {view: rng.integers(0, 256, (3, 128, 256), dtype=np.uint8) for view in VIEWS}
