"""Invariants of every demonstration, wherever it comes from."""

from collections.abc import Iterator

import numpy as np

from openvima.data.records import Demonstration
from openvima.data.schema import IMAGE_SHAPE, UNKNOWN_ID, VIEWS
from openvima.scene import (
    ACTION_SHAPES,
    BACKGROUND_ID,
    END_EFFECTORS,
    FIRST_OBJECT_ID,
    WORKSPACE_HIGH,
    WORKSPACE_LOW,
)
from openvima.tasks.oracle import TIED_TO_TABLE

PUBLISHED = "published"  # domain of imported demonstrations
_UNIT_TOLERANCE = 1e-3  # float32 quaternions of published data are off by up to 1e-7


def faults(demo: Demonstration) -> Iterator[str]:
    """Yield violated invariants of a demonstration.

    Args:
        demo: The demonstration, with its images.
    """
    yield from _image_faults(demo)
    yield from _action_faults(demo)
    yield from _object_faults(demo)
    yield from _scene_faults(demo)
    if demo.end_effector not in END_EFFECTORS:
        yield f"the end effector {demo.end_effector!r} does not exist"
    if demo.outcome.success and demo.outcome.failure:
        yield "it is both a success and a failure"
    if demo.num_steps > demo.max_steps:
        yield "it has more actions than steps are allowed"


def _image_faults(demo: Demonstration) -> Iterator[str]:
    num_seen = demo.num_steps + 1
    for view in VIEWS:
        if demo.rgb[view].shape != (num_seen, 3, *IMAGE_SHAPE):
            yield f"the {view} view does not have one image more than there are actions"
        if demo.segm[view].shape != (num_seen, *IMAGE_SHAPE):
            yield f"the {view} view does not have one segmentation more than there are actions"
    first = FIRST_OBJECT_ID.get(demo.end_effector, 0)
    known = {*range(first), BACKGROUND_ID, *(record.object_id for record in demo.objects)}
    for view in VIEWS:
        counts = np.bincount(demo.segm[view].reshape(-1), minlength=1)
        if not known.issuperset(np.flatnonzero(counts).tolist()):
            yield f"the segmentation of the {view} view shows an object that is not in the scene"


def _action_faults(demo: Demonstration) -> Iterator[str]:
    actions = {key: np.array([getattr(action, key) for action in demo.actions]) for key in ACTION_SHAPES}
    for key, values in actions.items():
        if not np.isfinite(values).all():
            yield f"{key} is not a number"
        elif demo.domain == PUBLISHED or not len(values):
            continue
        elif key.endswith("position"):
            low, high = (np.array(corner, np.float32) for corner in (WORKSPACE_LOW, WORKSPACE_HIGH))
            if (values < low).any() or (values > high).any():
                yield f"{key} lies outside the workspace"
        elif (np.abs(np.linalg.norm(values, axis=-1) - 1) > _UNIT_TOLERANCE).any():
            yield f"{key} is no unit quaternion"


def _object_faults(demo: Demonstration) -> Iterator[str]:
    ids = [record.object_id for record in demo.objects]
    if len(set(ids)) < len(ids):
        yield "two objects have the same id"
    for name, own in (("pick_ids", {*ids, UNKNOWN_ID}), ("place_ids", {*ids, UNKNOWN_ID, TIED_TO_TABLE})):
        values = getattr(demo, name)
        if len(values) != demo.num_steps:
            yield f"{name} does not have one id an action"
        if not own.issuperset(values):
            yield f"{name} names an object that is not in the scene"


def _scene_faults(demo: Demonstration) -> Iterator[str]:
    if demo.scenes and len(demo.scenes) != demo.num_steps + 1:
        yield "the objects do not have one pose more than there are actions"
    poses = np.array(
        [[*p.pose.position, *p.pose.quaternion] for scene in demo.scenes for p in scene.placements]
    )
    if not np.isfinite(poses).all():
        yield "a pose is not a number"
    if demo.joint_paths and len(demo.joint_paths) != demo.num_steps:
        yield "the arm does not have one path an action"
    if not all(np.isfinite(path).all() for path in demo.joint_paths):
        yield "a path of the arm is not a number"
