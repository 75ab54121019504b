"""A little of `benchmarks/soak.py`: random actions over all tasks do no harm, and the benchmark sees harm."""

import math
import re

import pytest

from openvima.env import TabletopEnv
from openvima.errors import ReachError
from openvima.scene import Pose
from openvima.sim.world import World
from openvima.tasks import list_tasks
from soak import LIMIT_TICKS, observation_problems, scene_problems, soak

ACTIONS = 9  # of each task


@pytest.mark.parametrize("task", list_tasks())
def test_random_actions_do_no_harm(task: str) -> None:
    findings = soak(task, ACTIONS)
    assert findings.problems == []
    assert findings.actions == ACTIONS
    assert findings.episodes > 0


def test_the_actions_are_reproducible_and_move_something() -> None:
    runs = [soak("rotate", 20, seed=1) for _ in range(2)]
    for findings in runs:
        findings.slowest_step_s = 0.0
    assert runs[0] == runs[1]
    assert runs[0].moved > 5


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (Pose((0.5, 0.0, math.nan)), r"object \d \(.*\) has pose"),
        (Pose((0.5, 0.0, -0.1)), "mm below the floor"),
        (Pose((5.0, 0.0, 0.1)), r"5\.0 m away"),
        (Pose((0.5, 0.0, 0.1), (0.0, 0.0, 0.0, 2.0)), "has quaternion"),
    ],
)
def test_a_pose_that_cannot_be_is_found(pose: Pose, message: str) -> None:
    env = TabletopEnv("rotate")
    env.reset(seed=0)
    assert scene_problems(env.scene, env.assets)[0] == []
    misplaced = env.scene.with_poses({env.scene.placements[0].id: pose})
    (problem,), _, _ = scene_problems(misplaced, env.assets)
    assert re.search(message, problem)


def test_an_id_that_no_object_has_is_found() -> None:
    env = TabletopEnv("rotate")
    observation, _ = env.reset(seed=0)
    assert observation_problems(env, observation) == []
    observation["segm"]["top"][0, 0] = 99
    assert observation_problems(env, observation) == ["the top view shows ids [99] that no object has"]


def test_an_error_and_too_many_ticks_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LIMIT_TICKS, "suction", -1)
    assert "ticks" in soak("rotate", 1).problems[0]

    def fail(*args: object, **options: object) -> None:
        raise ReachError("too far")

    monkeypatch.setattr(World, "execute", fail)
    assert "ReachError: too far" in soak("rotate", 1).problems[0]
