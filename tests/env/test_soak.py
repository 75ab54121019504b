"""Random valid actions over all tasks do no harm: finite poses, on the table, well-formed observations."""

import itertools
import math

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
