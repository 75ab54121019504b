"""Reader of recorded episodes of the public benchmark, and the comparison of our physics with its physics.

A recording holds, for every step, the action and the poses of all bodies before and after it. Every step is
replayed from its recorded start, so that differences do not add up.
"""

import gzip
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from golden_scenes import link_pose, size_and_scale
from openvima.catalog import Assets, object_spec
from openvima.scene import Action, Placement, Pose, Scene, angle_difference
from openvima.sim import World

MOVED_M = 0.005  # a body counts as moved from this distance …
MOVED_RAD = math.radians(3)  # … or turn on


@dataclass(frozen=True, slots=True, eq=False)
class RecordedStep:
    """One step of a recorded episode.

    Args:
        task: Name of the task.
        mode: "oracle" or "perturbed".
        name: Where it comes from, for messages.
        before: The bodies at their link-frame poses.
        action: What was done.
        after: Object id to link-frame pose afterwards.
    """

    task: str
    mode: str
    name: str
    before: Scene
    action: Action
    after: dict[int, Pose]


@dataclass(frozen=True, slots=True)
class Difference:
    """How one free body of one step came to lie, here and there.

    Args:
        is_lifted: It was grasped here.
        is_swept: The step was a sweep.
        moved: Whether the benchmark moved it.
        moved_here: Whether we did.
        position_m: Planar distance of the two results.
        yaw_rad: Angle between them.
    """

    is_lifted: bool
    is_swept: bool
    moved: bool
    moved_here: bool
    position_m: float
    yaw_rad: float


def read_steps(path: Path) -> Iterator[RecordedStep]:
    """Read all steps of a recording (`episodes.json.gz`), episode by episode."""
    with gzip.open(path, "rt", encoding="utf-8") as file:
        episodes = json.load(file)
    for episode in episodes:
        bodies = {int(number): body for number, body in episode["objects"].items()}
        for number, step in enumerate(episode["steps"]):
            name = f"{episode['task']}-{episode['seed']} step {number}"
            before = Scene(
                tuple(
                    _placement(object_id, bodies[object_id], numbers)
                    for object_id, numbers in sorted(
                        (int(key), value) for key, value in step["before"].items()
                    )
                ),
                episode["end_effector"],
            )
            after = {
                int(key): _link_pose(bodies[int(key)]["name"], numbers)
                for key, numbers in step["after"].items()
            }
            action = {key: np.array(value, dtype=np.float32) for key, value in step["action"].items()}
            yield RecordedStep(
                episode["task"], episode["mode"], name, before, Action.from_arrays(action), after
            )


def _placement(object_id: int, body: dict[str, Any], numbers: list[float]) -> Placement:
    size, scale = size_and_scale(body)
    pose = _link_pose(body["name"], numbers)
    fixed = body["category"] == "fixed"
    return Placement(object_id, body["name"], body["texture"], size, pose, fixed, scale)


def _link_pose(object_name: str, numbers: list[float]) -> Pose:
    return link_pose({"name": object_name, "pos": numbers[:3], "quat_xyzw": numbers[3:]})


def replay(step: RecordedStep, assets: Assets) -> list[Difference]:
    """Replay one step and compare every free body with the recording."""
    world = World(step.before, assets, compat=True)
    execution = world.execute(step.action)
    differences = []
    for start, end in zip(step.before.placements, world.scene.placements, strict=True):
        if start.fixed:
            continue
        theirs = step.after[start.id]
        symmetry = object_spec(start.object).symmetry_rad
        differences.append(
            Difference(
                is_lifted=execution.grasped == start.id,
                is_swept=step.before.end_effector == "spatula",
                moved=_has_moved(start.pose, theirs),
                moved_here=_has_moved(start.pose, end.pose),
                position_m=end.pose.planar_distance(theirs),
                yaw_rad=angle_difference(
                    end.pose.yaw_rad, theirs.yaw_rad, 2 * math.pi if symmetry is None else symmetry
                ),
            )
        )
    return differences


def _has_moved(before: Pose, after: Pose) -> bool:
    turn = angle_difference(before.yaw_rad, after.yaw_rad)
    return before.planar_distance(after) > MOVED_M or turn > MOVED_RAD


def summary(differences: list[Difference]) -> dict[str, float | int | None]:
    """Summarise how well results agree; medians are None where there is nothing to compare.

    Returns:
        `same_moved`: share of free bodies that moved there and here, or stayed there and here;
        `place_error_mm_median` and `yaw_error_deg_median`: of bodies that were lifted;
        `sweep_error_mm_median`: of bodies that the benchmark's blade moved.
    """
    lifted = [d for d in differences if d.is_lifted and d.moved]
    swept = [d for d in differences if d.is_swept and d.moved]
    return {
        "same_moved": sum(d.moved == d.moved_here for d in differences) / len(differences),
        "place_error_mm_median": _median([d.position_m * 1e3 for d in lifted]),
        "yaw_error_deg_median": _median([math.degrees(d.yaw_rad) for d in lifted]),
        "sweep_error_mm_median": _median([d.position_m * 1e3 for d in swept]),
        "num_bodies": len(differences),
        "num_lifted": len(lifted),
        "num_swept": len(swept),
    }


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None
