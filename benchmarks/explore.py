"""Whether low-level control survives exploration: random commands, each held for some steps, in all tasks.

    python benchmarks/explore.py [--episodes N] [--steps N] [--tasks a,b|all] [--seed S] [--limit-s S]

One command in five is the oracle's. Commands push against every bound of the workspace and the reach. No step
may raise, every observation must lie in its space, and the tool stays 2 cm around the workspace and at most
0.35 m above the table. Exit status 1 if anything was found.
"""

import argparse
import os
import sys
import time
import traceback
from contextlib import suppress

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from openvima.env import TabletopEnv
from openvima.errors import OracleError, SamplingError
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW
from openvima.scene.command import COMMAND_HIGH, COMMAND_LOW, END_EFFECTOR, HIGHEST_TIP_Z_M
from openvima.tasks import list_tasks

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


def main() -> int:
    """Explore, and print a line for each task."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=2000, help="of all tasks together (default: 2000)")
    parser.add_argument("--steps", type=int, default=100, help="of each episode (default: 100, that is 10 s)")
    parser.add_argument("--tasks", default="all", help="names with commas between (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="added to the episodes' seeds (default: 0)")
    parser.add_argument("--limit-s", type=float, default=float("inf"), help="begin no episode after this")
    given = parser.parse_args()
    tasks = list_tasks() if given.tasks == "all" else given.tasks.split(",")
    envs = {task: TabletopEnv(task, modalities=("joints",), control=END_EFFECTOR) for task in tasks}
    began, played, found = time.perf_counter(), 0, 0
    for number in range(given.episodes):
        if time.perf_counter() - began > given.limit_s:
            break
        task, seed = tasks[number % len(tasks)], FIRST_SEED + given.seed + number
        problems = explore(envs[task], seed, steps=given.steps)
        played += 1
        found += bool(problems)
        for problem in problems[:3]:
            print(f"{task}, seed {seed}, {problem}", flush=True)
    print(f"{played} episodes in {time.perf_counter() - began:.0f} s; {found} with problems")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
