"""Actions from what a user clicks: an object and a place, or the two ends of a sweep."""

import math

from openvima.errors import SceneError
from openvima.render.raycast import TABLE, Hit
from openvima.scene import Action, Pose, Scene
from openvima.tasks.pushes import Push

Point = tuple[float, float]


def clicked_action(scene: Scene, first: Hit, second: Hit, *, turn_rad: float = 0.0) -> Action:
    """Return the action of two clicks.

    Args:
        scene: The scene that was clicked.
        first: What to pick. With the spatula: the block to sweep, behind which the sweep then starts, or the
            point of the table where it starts.
        second: Where to place, or where the sweep ends.
        turn_rad: Rotation of the picked object, counter-clockwise seen from above; sweeps have none.

    Raises:
        SceneError: The first click of a pick is on no object, or on one that is fixed to the table.
    """
    start, end = _planar(first), _planar(second)
    if scene.end_effector == "spatula":
        if first.object_id != TABLE and not scene[first.object_id].fixed:
            pose = scene[first.object_id].pose
            start = Push.between((pose.x, pose.y), end).behind()
        return Action.planar(start, end)
    if first.object_id == TABLE:
        raise SceneError(f"there is no object at ({start[0]:.3f}, {start[1]:.3f}); click an object to pick.")
    if scene[first.object_id].fixed:
        raise SceneError(f"{scene.describe(first.object_id)} is fixed to the table; click another object.")
    return Action.planar(start, end, turn_rad)


def pose_after(pose: Pose, action: Action) -> Pose:
    """Return where a pick-and-place action would put an object, at the height that it has.

    Args:
        pose: Pose of the object.
        action: The action, which picks it.
    """
    turn_rad = math.remainder(action.yaw1_rad - action.yaw0_rad, 2 * math.pi)
    picked_from_object = Pose.planar(*action.pose0_position).inverse() @ pose
    return Pose.planar(*action.pose1_position, turn_rad) @ picked_from_object


def _planar(hit: Hit) -> Point:
    x, y, _ = hit.point
    return x, y
