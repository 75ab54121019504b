"""Low-level control takes any commands, those against every bound of the workspace and the reach included."""

import itertools
import math
import os
import traceback
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

import openvima
from openvima.catalog import Assets
from openvima.env import TabletopEnv
from openvima.errors import OracleError, SamplingError
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW, Scene
from openvima.scene.action import COMMAND_HIGH, COMMAND_LOW, HIGHEST_TIP_Z_M
from openvima.sim.model import FLOOR_Z_M
from openvima.tasks import list_tasks, task_spec
from task_cases import random_action

FIRST_SEED = 3_000_000
LONGEST_HOLD = 12  # steps
ORACLE_PROB = 0.2
BEYOND_M = 0.02 + 1e-6  # by which the tool may leave the workspace; observations are float32


def explore(env: TabletopEnv, seed: int, *, steps: int) -> list[str]:
    """Explore one episode; return what went wrong, at most one line for each step."""
    rng = np.random.default_rng(seed)
    try:
        observation, _ = env.reset(seed=seed)
    except SamplingError:
        return []
    problems = problems_of(env, observation)
    held, left = np.zeros(5, np.float32), 0
    for step in range(steps):
        if left == 0:
            held, left = random_command(rng), int(rng.integers(1, LONGEST_HOLD + 1))
        left -= 1
        command = held
        if rng.random() < ORACLE_PROB:
            with suppress(OracleError):  # it has no action: nothing is left to do
                command = env.oracle_command().to_array()
        try:
            observation, _, terminated, truncated, _ = env.step(command)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1].name
            return [*problems, f"step {step}: {type(error).__name__} in {place}: {error}"]
        problems += [f"step {step}: {problem}" for problem in problems_of(env, observation)]
        if terminated or truncated:
            break
    return problems


def random_command(rng: np.random.Generator) -> np.ndarray:
    """Draw a command, half of its numbers at a bound: exploration ends at walls."""
    low, high = np.array(COMMAND_LOW), np.array(COMMAND_HIGH)
    values = rng.uniform(low, high)
    at_bound = rng.random(5) < 0.5
    return np.where(at_bound, np.where(rng.random(5) < 0.5, low, high), values).astype(np.float32)


def problems_of(env: TabletopEnv, observation: dict) -> list[str]:
    """Look for what an observation must not hold."""
    x, y, z = observation["tool"][:3].tolist()
    problems = [] if env.observation_space.contains(observation) else ["the observation is not in its space"]
    (low_x, low_y), (high_x, high_y) = WORKSPACE_LOW, WORKSPACE_HIGH
    is_inside = low_x - BEYOND_M <= x <= high_x + BEYOND_M and low_y - BEYOND_M <= y <= high_y + BEYOND_M
    if not is_inside or not 0 <= z <= HIGHEST_TIP_Z_M + 1e-6:
        problems.append(f"the tool is at ({x:.4f}, {y:.4f}, {z:.4f}) m")
    return problems


def make(task: str) -> openvima.TabletopEnv:
    return openvima.make(task, control="end_effector", modalities=("joints",))


@pytest.mark.parametrize(
    ("task", "episodes"),
    [
        ("visual_manipulation", 4),
        ("sweep_without_exceeding", 4),
        *(
            pytest.param(task, 8, marks=pytest.mark.slow)
            for task in ("pick_in_order_then_restore", "sweep_without_touching")
        ),
    ],
)
def test_smooth_exploration_raises_nothing_and_stays_in_the_space(task: str, episodes: int) -> None:
    env = make(task)
    for seed in range(FIRST_SEED, FIRST_SEED + episodes):
        assert explore(env, seed, steps=100) == [], seed


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
        *(pytest.param(task, 20, marks=pytest.mark.slow) for task in list_tasks()),
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
