"""With `compat`, starts, prompts and sweeps are those of the original benchmark."""

import gzip
import json
import os
import re
from pathlib import Path

import pytest

from openvima.catalog import object_spec
from openvima.scene import (
    FIRST_OBJECT_ID,
    InZone,
    NeverTouches,
    Placement,
    Pose,
    Problem,
    Prompt,
    Scene,
    Zone,
)
from openvima.tasks import advance, begin, list_tasks, sample_episode, task_spec
from openvima.tasks.sweeping import published_sweep

GOLDEN = Path(os.environ.get("OPENVIMA_GOLDEN", Path(__file__).parents[3] / "shared" / "golden"))
EPISODES = GOLDEN / "dynamics" / "episodes.json.gz"
SCENES = GOLDEN / "scenes"
RECORDS = [(task, path) for task in list_tasks() for path in sorted(SCENES.glob(f"{task}-*.json"))]

MOUTH_ZONE, MOUTH_LINE = Zone(0.39, 0.0, 0.172, 0.3), Zone(0.496, 0.0, 0.04, 0.1875)
DIVIDER, LANE = 0.14375, 0.19375  # m, for that line


def block(object_id: int, pose: Pose) -> Placement:
    return Placement(object_id, "small block", "red", (0.03, 0.03, 0.03), pose)


def problem_with(poses: dict[int, Pose], zone: Zone, line: Zone, num_swept: int) -> Problem:
    ids = tuple(poses)[:num_swept]
    return Problem(
        scene=Scene(tuple(block(object_id, pose) for object_id, pose in poses.items()), "spatula"),
        prompt=Prompt("", ()),
        goals=tuple(InZone(object_id, zone) for object_id in ids),
        constraints=(NeverTouches(ids, line, "line"),),
    )


def end_of(x: float, y: float, *, zone: Zone = MOUTH_ZONE, line: Zone = MOUTH_LINE) -> tuple[float, float]:
    problem = problem_with({4: Pose.planar(x, y)}, zone, line, num_swept=1)
    (goal,) = problem.goals
    assert isinstance(goal, InZone)
    sweep = published_sweep(goal, problem.scene, problem)
    assert sweep.start == (x, y) and sweep.goal is goal
    return sweep.end


@pytest.mark.parametrize(
    ("place", "end"),
    [
        ((0.65, 0.05), (0.623, LANE)),  # in front of the line: out to the lane of its side
        ((0.65, -0.05), (0.623, -LANE)),
        ((0.65, 0.0), (0.623, LANE)),
        ((0.65, DIVIDER - 1e-6), (0.623, LANE)),
        ((0.65, DIVIDER + 1e-6), (0.37, LANE)),  # beside it: along the lane
        ((0.497, 0.1), (0.623, LANE)),
        ((0.495, 0.1), (0.39, 0.0)),  # past it: into the zone
        ((0.457, -0.2), (0.37, -LANE)),
        ((0.455, -0.2), (0.39, 0.0)),
    ],
)
def test_a_line_at_the_mouth_is_passed_in_three_phases(
    place: tuple[float, float], end: tuple[float, float]
) -> None:
    assert end_of(*place) == pytest.approx(end)


def test_a_longer_line_has_its_lane_farther_out_and_one_behind_the_zone_does_not_matter() -> None:
    zone, line = Zone(0.5, 0.0, 0.1, 0.27), Zone(0.41, 0.0, 0.04, 0.34)
    assert end_of(0.65, 0.05, zone=zone, line=line) == (0.5, 0.0)
    assert end_of(0.65, 0.2, line=Zone(0.496, 0.0, 0.04, 0.4625)) == pytest.approx((0.623, 0.33125))


@pytest.mark.skipif(not EPISODES.is_file(), reason=f"{EPISODES} is absent; set OPENVIMA_GOLDEN")
def test_golden_sweeps_of_the_oracle_are_ours() -> None:
    episodes = json.loads(gzip.decompress(EPISODES.read_bytes()))
    recorded = [e for e in episodes if e["mode"] == "oracle" and e["task"].startswith("sweep_")]
    num_sweeps = 0
    for episode in recorded:
        names = {int(i): described["name"] for i, described in episode["objects"].items()}
        blocks = sorted(i for i, name in names.items() if name == "small block")
        (line_id,) = (i for i, name in names.items() if name == "line")
        zone, line = _zones(episode["task"], line_x=episode["steps"][0]["before"][str(line_id)][0])
        problem = problem_with({i: Pose.planar(0, 0) for i in blocks}, zone, line, num_swept=len(blocks) // 2)
        progress = begin(problem)
        for step in episode["steps"]:
            before, after = (
                problem.scene.with_poses({i: _pose(step[key][str(i)]) for i in blocks})
                for key in ("before", "after")
            )
            goal = problem.goals[progress.open_goals[0]]
            assert isinstance(goal, InZone)
            sweep = published_sweep(goal, before, problem)
            assert sweep.start == pytest.approx(step["action"]["pose0_position"], abs=1e-4)
            assert sweep.end == pytest.approx(step["action"]["pose1_position"], abs=1e-4)
            progress, _ = advance(problem, progress, after)
            num_sweeps += 1
    assert num_sweeps >= 10


def _zones(task: str, *, line_x: float) -> tuple[Zone, Zone]:
    if task == "sweep_without_touching":
        return MOUTH_ZONE, MOUTH_LINE
    depth = 0.545 - line_x - 0.02
    zone = Zone((0.545 + line_x + 0.02) / 2 + 0.015, 0.0, depth, 0.27)
    return zone, Zone(line_x, 0.0, 0.04, 0.3375)


def _pose(numbers: list[float]) -> Pose:
    return Pose(tuple(numbers[:3]), tuple(numbers[3:]))


@pytest.mark.skipif(not RECORDS, reason=f"no recorded scenes in {SCENES} (set OPENVIMA_GOLDEN)")
@pytest.mark.parametrize(("task", "path"), RECORDS, ids=[path.stem for _, path in RECORDS])
def test_golden_starts_have_the_form_ids_roles_and_heights_of_ours(task: str, path: Path) -> None:
    record = json.loads(path.read_text(encoding="utf-8"))
    problem = sample_episode(task, seed=0, compat=True).problem
    assert set(record["assets"]) == {name for name, _ in problem.prompt.images}
    words = re.split(r"\{\w+\}", task_spec(task).template)
    pattern = r"(?:\{\w+\}|[\w -]+)".join(re.escape(word) for word in words)
    assert re.fullmatch(pattern, record["prompt"]) and re.fullmatch(pattern, problem.prompt.text)
    ours = problem.scene
    assert ours.end_effector == record["end_effector"]
    assert record["objects"][0]["id"] == ours.placements[0].id == FIRST_OBJECT_ID[ours.end_effector]
    recorded = {o["name"]: o for o in record["objects"]}
    for placement in ours.placements:
        if placement.object not in recorded or placement.object in ("bowl", "frame"):
            continue  # those two were recorded by a centre of mass beside the link frame
        other = recorded[placement.object]
        spec = object_spec(placement.object)
        if spec.size_min == spec.size_max and not task.startswith("novel_adj"):  # heights drawn at random
            assert placement.pose.z == pytest.approx(other["pos"][2])
        assert ("fixed" if placement.fixed else "rigid") == other["category"]
        if placement.object in ("line", "three-sided rectangle"):
            boxes = [shape["dims"] for shape in other["shapes"]]
            assert max(map(max, boxes)) == pytest.approx(max(placement.size))
            assert placement.pose.quaternion == pytest.approx(other["quat_xyzw"])
