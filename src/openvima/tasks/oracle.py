"""The scripted solver: one action at a time, from the true poses of all objects."""

import math
from dataclasses import dataclass

import numpy as np

from openvima.catalog import Assets
from openvima.errors import OracleError
from openvima.scene import Action, AtPose, InZone, Pose, Problem, Scene
from openvima.tasks.goals import Progress
from openvima.tasks.sweeping import plan_sweep

TIED_TO_TABLE = -1


@dataclass(frozen=True, slots=True)
class OracleDecision:
    """An action and what it is about, for policies that learn to point.

    Args:
        action: The action.
        pick_id: Id of the object to pick or to sweep.
        place_id: Id of the object that the place is tied to: the base, the object itself if it only turns,
            the line in front of which blocks are swept. -1 if the place is tied to the table.
    """

    action: Action
    pick_id: int
    place_id: int


def oracle_action(
    problem: Problem,
    progress: Progress,
    scene: Scene,
    *,
    assets: Assets,
    rng: np.random.Generator,
    compat: bool = False,
) -> OracleDecision:
    """Return the next action: what has to be done first, then towards the first open goal.

    Of blocks to sweep the easiest one comes first.

    Args:
        problem: The episode's problem.
        progress: Which goals are still open.
        scene: Where the objects are now.
        assets: Where their shapes come from.
        rng: Drawn from only with `compat`.
        compat: Act as the original benchmark's oracle does: pick at a random visible point, turn every object
            to its target's heading, sweep blocks in order without looking.

    Returns:
        The action, which stays within the bounds of actions.

    Raises:
        OracleError: No goal is open, or the object to move cannot be seen from above.
    """
    goals = [problem.goals[index] for index in progress.open_goals]
    if not goals:
        raise OracleError("all goals are met; the oracle has nothing left to do. Reset the environment.")
    chores = [goal for goal in problem.prerequisites if not goal.is_met(scene)]
    goal = (chores or goals)[0]
    if isinstance(goal, AtPose):
        point = visible_point(scene, goal.object_id, assets=assets, rng=rng if compat else None)
        action = _pick_and_place(goal, scene[goal.object_id].pose, point, compat=compat)
    else:
        zone_goals = [goal for goal in goals if isinstance(goal, InZone)]
        sweep = plan_sweep(zone_goals, scene, problem, compat=compat)
        goal, action = sweep.goal, Action.planar(sweep.start, sweep.end)
    place_id = TIED_TO_TABLE if goal.relative_to is None else goal.relative_to
    return OracleDecision(action, goal.object_id, place_id)


def visible_point(
    scene: Scene, object_id: int, *, assets: Assets, rng: np.random.Generator | None = None
) -> tuple[float, float]:
    """Return a point at which an object is topmost, seen from straight above.

    Args:
        scene: Where the objects are.
        object_id: The object to be picked.
        assets: Where shapes come from.
        rng: If given, any visible cell of the raster is drawn, and its lower corner returned, as the original
            benchmark does. Else the answer is the centre of the cell that is farthest from the object's
            visible outline; among equals the nearest to the object's origin.

    Returns:
        x, y in metres.

    Raises:
        OracleError: Nothing of the object can be seen within the workspace.
    """
    from openvima.render.labels import CELL_M, cell_centres, label_raster

    labels = label_raster(scene, assets)
    rows, columns = np.nonzero(labels == object_id)
    if not len(rows):
        shown = f"object {object_id} ({scene[object_id].texture} {scene[object_id].object})"
        raise OracleError(f"nothing of {shown} can be seen from above, so it cannot be picked.")
    points = cell_centres(rows, columns)
    if rng is not None:
        x, y = (points[rng.integers(len(points))] - CELL_M / 2).tolist()
        return x, y
    depths = _squared_depths(labels, object_id, rows, columns)
    deepest = points[depths == depths.max()]
    pose = scene[object_id].pose
    offsets = deepest - (pose.x, pose.y)
    x, y = deepest[np.argmin((offsets * offsets).sum(axis=1))].tolist()
    return x, y


def _squared_depths(labels: np.ndarray, object_id: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Squared distances of an object's cells to the nearest cell that is not of it, in the order given."""
    from openvima.tasks.kernels import squared_depths

    top, left = int(rows.min()), int(columns.min())
    depths = np.empty((int(rows.max()) - top + 1, int(columns.max()) - left + 1), np.int32)
    squared_depths(labels, object_id, top, left, np.empty_like(depths), depths)
    return depths[rows - top, columns - left]


def _pick_and_place(goal: AtPose, pose: Pose, point: tuple[float, float], *, compat: bool) -> Action:
    """Action that brings the object's origin to the target's, with the least turn that the goal asks for."""
    in_base = goal.relative_to is not None and goal.relative_to != goal.object_id
    if in_base and goal.tolerance.yaw_rad is None and not compat:
        turn_rad = 0.0  # any heading is fine there
    else:
        turn_rad = math.remainder(goal.target.yaw_rad - pose.yaw_rad, 2 * math.pi)
    offset = Pose.planar(0, 0, turn_rad) @ Pose((point[0] - pose.x, point[1] - pose.y, 0.0))
    return Action.planar(point, (goal.target.x + offset.x, goal.target.y + offset.y), turn_rad)
