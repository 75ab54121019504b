"""Agreement of the physics with VIMA-Bench: final poses of bodies after recorded actions.

    python benchmarks/dynamics.py --episodes FILE [FILE …] --assets DIR [--json FILE]

Replays every step of recorded episodes from its recorded start, with the original asset pack and the
benchmark's inexact arm (`compat`). `oracle` steps are clean solutions; `perturbed` ones rotate and shift
place poses, stack objects and miss picks. A body counts as moved from 5 mm on. Steps in which
other bodies moved, or one ended more than 20 mm elsewhere, are listed one by one.

A recording holds, for every step, the action and the poses of all bodies before and after it. Every step is
replayed from its recorded start, so that differences do not add up.
"""

import argparse
import gzip
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fidelity import link_pose, size_and_scale
from openvima.catalog import Assets, object_spec
from openvima.catalog.original import OriginalAssets
from openvima.scene import Action, Placement, Pose, Scene, angle_difference
from openvima.sim import World

MOVED_M = 0.005  # a body counts as moved from this planar distance on
TURNED_RAD = math.radians(3)  # one that was carried may also just have been turned
FAR_M = 0.02  # bodies that end farther apart than this are listed one by one


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
class BodyDifference:
    """How one free body of one step came to lie, in the recording ("there") and here.

    Args:
        label: Object id and name, for messages.
        moved_there_m: Planar way in the recording.
        moved_here_m: Planar way here.
        apart_m: Planar distance of the two results.
        apart_rad: Angle between them, up to the body's symmetry.
        is_carried: The action carried it: it was lifted here or, if nothing was, the one that moved farthest
            there.
    """

    label: str
    moved_there_m: float
    moved_here_m: float
    apart_m: float
    apart_rad: float
    is_carried: bool

    @property
    def moved_there(self) -> bool:
        """Whether the benchmark moved it."""
        return self.moved_there_m > MOVED_M

    @property
    def moved_here(self) -> bool:
        """Whether we did."""
        return self.moved_here_m > MOVED_M

    @property
    def is_far(self) -> bool:
        """Whether it moved and ended far from where it does in the recording."""
        return (self.moved_there or self.moved_here) and self.apart_m > FAR_M


@dataclass(frozen=True, slots=True)
class StepDifference:
    """How one step came out, in the recording and here.

    Args:
        step: What was replayed.
        bodies: The free bodies.
    """

    step: RecordedStep
    bodies: tuple[BodyDifference, ...]

    @property
    def same_moved(self) -> bool:
        """Whether the same bodies moved."""
        return all(body.moved_there == body.moved_here for body in self.bodies)


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


def replay(step: RecordedStep, assets: Assets) -> StepDifference:
    """Replay one step and compare every free body with the recording."""
    world = World(step.before, assets, compat=True)
    grasped = world.execute(step.action).grasped
    free = [placement for placement in step.before.placements if not placement.fixed]
    carried = grasped
    if step.before.end_effector == "suction" and grasped is None and free:
        farthest = max(free, key=lambda body: body.pose.planar_distance(step.after[body.id]))
        turn = angle_difference(farthest.pose.yaw_rad, step.after[farthest.id].yaw_rad)
        is_moved = farthest.pose.planar_distance(step.after[farthest.id]) > MOVED_M or turn > TURNED_RAD
        carried = farthest.id if is_moved else None
    return StepDifference(step, tuple(_compared(body, world.scene, step, carried) for body in free))


def _compared(start: Placement, ours: Scene, step: RecordedStep, carried: int | None) -> BodyDifference:
    here, there = ours[start.id].pose, step.after[start.id]
    symmetry = object_spec(start.object).symmetry_rad
    period_rad = 2 * math.pi if symmetry is None else symmetry
    return BodyDifference(
        label=f"{start.id} {start.object}",
        moved_there_m=start.pose.planar_distance(there),
        moved_here_m=start.pose.planar_distance(here),
        apart_m=here.planar_distance(there),
        apart_rad=angle_difference(here.yaw_rad, there.yaw_rad, period_rad),
        is_carried=start.id == carried,
    )


def summary(steps: Iterable[StepDifference]) -> dict[str, float | int | None]:
    """Summarise how well results agree; medians are None where there is nothing to compare.

    Returns:
        `same_moved`: share of steps in which the same bodies moved; `place_error_mm_median` and
        `yaw_error_deg_median`: of bodies that were carried; `sweep_error_mm_median`: of bodies that the
        benchmark's spatula moved.
    """
    steps = tuple(steps)
    carried = [body for step in steps for body in step.bodies if body.is_carried]
    swept = [
        body
        for step in steps
        if step.step.before.end_effector == "spatula"
        for body in step.bodies
        if body.moved_there
    ]
    return {
        "same_moved": sum(step.same_moved for step in steps) / len(steps),
        "place_error_mm_median": _median([body.apart_m * 1e3 for body in carried]),
        "yaw_error_deg_median": _median([math.degrees(body.apart_rad) for body in carried]),
        "sweep_error_mm_median": _median([body.apart_m * 1e3 for body in swept]),
        "num_steps": len(steps),
        "num_same_moved": sum(step.same_moved for step in steps),
        "num_carried": len(carried),
        "num_swept": len(swept),
        "num_far": sum(body.is_far for step in steps for body in step.bodies),
    }


def _median(values: list[float]) -> float | None:
    return float(np.median(values)) if values else None


def main() -> None:
    """Replay all steps of a file, print tables, and write the result as JSON if asked."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--episodes", type=Path, nargs="+", required=True, help="recorded episodes, such as episodes.json.gz"
    )
    parser.add_argument("--assets", type=Path, required=True, help="checkout with the original asset pack")
    parser.add_argument("--json", type=Path, help="file to write the result to")
    arguments = parser.parse_args()
    assets = OriginalAssets(arguments.assets)
    steps = [replay(step, assets) for file in arguments.episodes for step in read_steps(file)]
    modes = sorted({step.step.mode for step in steps})
    tasks = sorted({step.step.task for step in steps})
    result = {
        "modes": {mode: summary(s for s in steps if s.step.mode == mode) for mode in modes},
        "tasks": {
            task: {
                mode: summary(chosen)
                for mode in modes
                if (chosen := [s for s in steps if (s.step.task, s.step.mode) == (task, mode)])
            }
            for task in tasks
        },
        "differences": [_record(step) for step in steps if _is_notable(step)],
    }
    print(f"{'task':28} {'mode':10} steps  same moved  place error  yaw error  sweep error  (medians)")
    for task in tasks:
        for mode, row in result["tasks"][task].items():
            print(_row(task, mode, row))
    for mode, row in result["modes"].items():
        print(_row("all", mode, row))
    print("\nOther bodies moved, or one lies more than 20 mm elsewhere:")
    for record in result["differences"]:
        print(f"{record['mode']} {record['step']}: {'; '.join(record['bodies'])}")
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _row(task: str, mode: str, row: dict[str, float | int | None]) -> str:
    return (
        f"{task:28} {mode:10} {row['num_steps']:5d} {row['same_moved']:11.3f}"
        f"{_cell(row['place_error_mm_median'], 'mm', 13)}{_cell(row['yaw_error_deg_median'], '°', 11)}"
        f"{_cell(row['sweep_error_mm_median'], 'mm', 13)}"
    )


def _cell(value: float | int | None, unit: str, width: int) -> str:
    return f"{'–' if value is None else f'{value:.2f} {unit}':>{width}}"


def _is_notable(step: StepDifference) -> bool:
    return not step.same_moved or any(body.is_far for body in step.bodies)


def _record(step: StepDifference) -> dict[str, Any]:
    bodies = [
        f"{body.label} moved {body.moved_there_m * 1e3:.1f} mm there, {body.moved_here_m * 1e3:.1f} mm here, "
        f"{body.apart_m * 1e3:.1f} mm and {math.degrees(body.apart_rad):.0f}° apart"
        for body in step.bodies
        if body.is_far or body.moved_there != body.moved_here
    ]
    return {
        "step": step.step.name,
        "mode": step.step.mode,
        "same_moved": step.same_moved,
        "bodies": bodies,
    }


if __name__ == "__main__":
    main()
