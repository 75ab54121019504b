"""Low-level control takes any commands, those against every bound of the workspace and the reach included."""

import traceback
from contextlib import suppress

import numpy as np
import pytest

import openvima
from openvima.env import TabletopEnv
from openvima.errors import OracleError, SamplingError
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW
from openvima.scene.action import COMMAND_HIGH, COMMAND_LOW, HIGHEST_TIP_Z_M

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
        ("visual_manipulation", 8),
        ("sweep_without_exceeding", 8),
        *(
            pytest.param(task, 25, marks=pytest.mark.slow)
            for task in ("pick_in_order_then_restore", "sweep_without_touching")
        ),
    ],
)
def test_smooth_exploration_raises_nothing_and_stays_in_the_space(task: str, episodes: int) -> None:
    env = make(task)
    for seed in range(FIRST_SEED, FIRST_SEED + episodes):
        assert explore(env, seed, steps=100) == [], seed


@pytest.mark.parametrize("task", ["rotate", "sweep_without_touching"])
def test_one_command_repeated_into_a_corner_stops_there(task: str) -> None:
    for first in ([0, 0, 0, 0, 0], [0, 0, 0.05, 0, 0], [0, 0, -0.05, 0, 0]):
        for command in ([0.05, 0.05, 0, 0, 0], [0.05, -0.05, 0, 0.2, 1], [0.05, 0.05, -0.05, 0, 1]):
            env = make(task)
            env.reset(seed=0)
            for each in (*[first] * 10, *[command] * 30):
                observation, _, terminated, truncated, _ = env.step(np.float32(each))
                assert observation in env.observation_space
                if terminated or truncated:
                    break
