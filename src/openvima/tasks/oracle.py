"""The scripted oracle: one action at a time, from the true poses of all objects."""

import math
from dataclasses import dataclass

import numpy as np

from openvima.catalog import Assets
from openvima.errors import OracleError, echo
from openvima.scene import Action, AtPose, InZone, Point, Pose, Problem, Scene
from openvima.scene.goal import object_of, oracle_move
from openvima.tasks.goals import Progress
from openvima.tasks.sweeping import plan_sweep

TIED_TO_TABLE = -1


@dataclass(frozen=True, slots=True)
class OracleDecision:
    """An action and the objects that it refers to.

    Args:
        action: The action.
        pick_id: Id of the object to pick or to sweep.
        place_id: Id of the object that the place pose is relative to: the base, the object itself for a
            rotation, the line in front of which blocks are swept. -1: relative to the table.
    """

    action: Action
    pick_id: int
    place_id: int


def require_goals(problem: Problem) -> None:
    """Raise an OracleError unless there is a goal to pursue."""
    if not problem.goals:
        raise OracleError("the episode has no goals, so the oracle has nothing to do; give it some.")


def oracle_action(
    problem: Problem,
    progress: Progress,
    scene: Scene,
    *,
    assets: Assets,
    rng: np.random.Generator,
    compat: bool = False,
) -> OracleDecision:
    """Return the next action: prerequisites first, then the first open goal; of blocks to sweep the easiest.

    Args:
        problem: The episode's problem.
        progress: The open goals.
        scene: The current scene.
        assets: Asset pack.
        rng: Used only with `compat`.
        compat: Act as VIMA-Bench's oracle does: pick at a random visible point, rotate every object to its
            target's heading, sweep blocks in order and ignore obstacles.

    Returns:
        The action, within the bounds of actions.

    Raises:
        OracleError: No goal is open, the first one states no move, or the object to move is not visible from
            above.
    """
    require_goals(problem)
    goals = [problem.goals[index] for index in progress.open_goals]
    done = {object_of(goal) for goal in problem.goals} - {object_of(goal) for goal in goals}
    if not goals:
        raise OracleError("all goals are met; the oracle has nothing left to do. Reset the environment.")
    pending = [g for g in problem.prerequisites if g.object_id not in done and not g.is_met(scene)]
    first = (pending or goals)[0]
    goal = oracle_move(first, scene)
    if goal is None:
        raise OracleError(
            f"the oracle cannot pursue the goal {echo(repr(first))}: it has no oracle_move(scene), or this "
            "returned None."
        )
    if isinstance(goal, AtPose):
        point = visible_point(scene, goal.object_id, assets=assets, rng=rng if compat else None)
        action = _pick_and_place(goal, scene[goal.object_id].pose, point, compat=compat)
    else:
        moves = (oracle_move(goal, scene) for goal in goals)
        sweep = plan_sweep([m for m in moves if isinstance(m, InZone)], scene, problem, compat=compat)
        goal, action = sweep.goal, Action.planar(sweep.start, sweep.end)
    place_id = TIED_TO_TABLE if goal.relative_to is None else goal.relative_to
    return OracleDecision(action, goal.object_id, place_id)


def visible_point(
    scene: Scene, object_id: int, *, assets: Assets, rng: np.random.Generator | None = None
) -> Point:
    """Return a point where an object is visible from straight above.

    Args:
        scene: The scene.
        object_id: The object to pick.
        assets: Asset pack.
        rng: If given, return the lower corner of a random visible cell, as VIMA-Bench does. Else return the
            centre of the cell farthest from the object's visible outline, nearest to its origin among equals.

    Returns:
        x, y in metres.

    Raises:
        OracleError: The object is not visible within the workspace.
    """
    from openvima.render.labels import CELL_M, cell_centres, label_raster
    from openvima.tasks.kernels import squared_depths

    labels = label_raster(scene, assets)
    rows, columns = np.nonzero(labels == object_id)
    if not len(rows):
        raise OracleError(f"{scene.describe(object_id)} is not visible from above, so it cannot be picked.")
    points = cell_centres(rows, columns)
    if rng is not None:
        x, y = (points[rng.integers(len(points))] - CELL_M / 2).tolist()
        return x, y
    mask = labels[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1] == object_id
    depths = np.empty(mask.shape, np.int32)
    squared_depths(mask, np.empty_like(depths), depths)
    deepest = points[depths[mask] == depths.max()]
    pose = scene[object_id].pose
    offsets = deepest - (pose.x, pose.y)
    x, y = deepest[np.argmin((offsets * offsets).sum(axis=1))].tolist()
    return x, y


def _pick_and_place(goal: AtPose, pose: Pose, point: Point, *, compat: bool) -> Action:
    """Action that moves the object's origin to the target's, with the smallest rotation that it needs."""
    in_base = goal.relative_to is not None and goal.relative_to != goal.object_id
    if in_base and goal.tolerance.yaw_rad is None and not compat:
        turn_rad = 0.0  # any heading is allowed
    else:
        turn_rad = math.remainder(goal.target.yaw_rad - pose.yaw_rad, 2 * math.pi)
    offset = Pose.planar(0, 0, turn_rad) @ Pose((point[0] - pose.x, point[1] - pose.y, 0.0))
    return Action.planar(point, (goal.target.x + offset.x, goal.target.y + offset.y), turn_rad)
