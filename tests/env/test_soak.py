"""Long use does no harm: random valid actions over all tasks, and memory and file handles after resets."""

import itertools
import math
import os
from pathlib import Path

import numpy as np
import pytest

from openvima.catalog import Assets
from openvima.env import TabletopEnv
from openvima.scene import Scene
from openvima.sim.model import FLOOR_Z_M
from openvima.tasks import list_tasks, task_spec
from task_cases import random_action

SINKING_M = 0.002  # by which the lowest corner may be below the floor: contacts are springs
FARTHEST_M = 3.0  # from the robot; nothing slides that far
NUM_RESETS = 400
MB = 2**20


def assert_possible(scene: Scene, assets: Assets) -> None:
    for placement in scene.placements:
        pose = placement.pose
        assert np.isfinite([*pose.position, *pose.quaternion]).all()
        assert math.hypot(*pose.quaternion) == pytest.approx(1, abs=1e-6)
        geometry = assets.geometry(placement.object, placement.size, placement.scale)
        corners = pose.transform(geometry.visual.vertices.reshape(-1, 3))
        assert corners[:, 2].min() - FLOOR_Z_M > -SINKING_M
        assert math.hypot(pose.x, pose.y) < FARTHEST_M


@pytest.mark.parametrize(
    ("task", "num_actions"),
    [
        *((task, 9) for task in ("rotate", "sweep_without_touching")),
        *(pytest.param(task, 40, marks=pytest.mark.slow) for task in list_tasks()),
    ],
)
def test_random_actions_do_no_harm(task: str, num_actions: int) -> None:
    rng, left = np.random.default_rng([*task.encode()]), num_actions
    envs = itertools.cycle(TabletopEnv(task, level=level) for level in task_spec(task).levels)
    for seed, env in enumerate(envs, 2_000_000):
        env.reset(seed=seed)
        is_over = False
        while left and not is_over:
            left -= 1
            observation, reward, terminated, truncated, info = env.step(random_action(rng, env.scene))
            assert_possible(env.scene, env.assets)
            assert observation in env.observation_space
            allowed = {0, 1, 255, *(placement.id for placement in env.scene.placements)}
            assert all(set(np.unique(segm).tolist()) <= allowed for segm in observation["segm"].values())
            assert (reward, terminated) == (float(info["success"]), info["success"] or info["failure"])
            is_over = terminated or truncated
        if not left:
            return


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def num_handles() -> int:
    return len(os.listdir("/proc/self/fd"))


@pytest.mark.slow
def test_hundreds_of_resets_leave_memory_and_file_handles_flat() -> None:
    env = TabletopEnv("novel_adj_and_noun")
    for seed in range(600):  # fills the caches of shapes, textures, hulls and models
        env.reset(seed=seed)
    before = resident_bytes(), num_handles()
    for seed in range(NUM_RESETS):
        env.reset(seed=1000 + seed)
    assert num_handles() <= before[1]  # earlier tests may have left some that are closed meanwhile
    assert resident_bytes() - before[0] < 10 * MB
