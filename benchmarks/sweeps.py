"""What skipping physics in sweeps saves and changes: bodies carried without it, bodies asleep.

    python benchmarks/sweeps.py [--episodes N] [--json FILE]

Replays every sweep of oracle episodes with physics for all bodies on the whole way, with a spatula faster by
0.1 and 1 % for comparison, and as the simulator does it. Differences are of blocks that moved by 5 mm.
"""

import argparse
import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from openvima.env import TabletopEnv
from openvima.scene import Action, Scene
from openvima.sim import World, spatula
from openvima.sim.spatula import Spatula

TASKS = ("sweep_without_exceeding", "sweep_without_touching")
FIRST_SEED = 2_000_000
MOVED_M = 0.005


def recorded_sweeps(num_episodes: int) -> Iterator[tuple[TabletopEnv, Scene, Action]]:
    """Yield environment, scene and action of every step of the oracle."""
    for task in TASKS:
        env = TabletopEnv(task, domain="train")
        for seed in range(FIRST_SEED, FIRST_SEED + num_episodes):
            env.reset(seed=seed)
            is_over = False
            while not is_over:
                scene, action = env.scene, env.oracle_decision().action
                yield env, scene, action
                _, _, is_over, is_truncated, _ = env.step(action)
                is_over = is_over or is_truncated


@contextmanager
def full_physics(speed: float = 1.0) -> Iterator[None]:
    """Run physics for every body on the whole way, the spatula faster by a factor."""
    with (
        patch.object(Spatula, "_carried_bodies", lambda _: None),
        patch.object(Spatula, "_wake", lambda moving, _: moving._sleeping.clear()),
        patch.object(spatula, "SWEEP_M_S", spatula.SWEEP_M_S * speed),
    ):
        yield


def execute(sweeps: list[tuple[TabletopEnv, Scene, Action]]) -> tuple[list[Scene], dict[str, float]]:
    """Execute all sweeps; return the final scenes and the mean cost of a sweep."""
    start, num_ticks, finals = time.process_time(), 0, []
    for env, scene, action in sweeps:
        world = World(scene, env.assets)
        num_ticks += world.execute(action).num_ticks
        finals.append(world.scene)
    elapsed_ms = 1000 * (time.process_time() - start)
    return finals, {"ticks": num_ticks / len(sweeps), "cpu_ms": elapsed_ms / len(sweeps)}


def differences_mm(starts: list[Scene], finals: list[Scene], expected: list[Scene]) -> dict[str, float]:
    """Summarise the planar distances of the moved blocks to where they are expected."""
    apart = [
        1000 * here[block.id].pose.planar_distance(there[block.id].pose)
        for start, here, there in zip(starts, finals, expected, strict=True)
        for block in start.placements
        if max(block.pose.planar_distance(final[block.id].pose) for final in (here, there)) > MOVED_M
    ]
    return {
        "num_blocks": len(apart),
        "median_mm": float(np.median(apart)),
        "p90_mm": float(np.percentile(apart, 90)),
        "max_mm": max(apart),
    }


def main() -> None:
    """Measure, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--episodes", type=int, default=40, help="episodes of each of the two tasks")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    sweeps = list(recorded_sweeps(options.episodes))
    starts = [scene for _, scene, _ in sweeps]
    with full_physics():
        expected, cost = execute(sweeps)
    result: dict[str, dict[str, Any]] = {"full physics": cost}
    for name, speed in {"spatula 0.1 % faster": 1.001, "spatula 1 % faster": 1.01}.items():
        with full_physics(speed):
            finals, cost = execute(sweeps)
        result[name] = cost | differences_mm(starts, finals, expected)
    finals, cost = execute(sweeps)
    result["as simulated"] = cost | differences_mm(starts, finals, expected)
    print(f"{len(sweeps)} sweeps")
    for name, row in result.items():
        print(f"{name:22}" + "".join(f"  {key} {value:.2f}" for key, value in row.items()))
    if options.json:
        options.json.write_text(json.dumps({"num_sweeps": len(sweeps), **result}, indent=2) + "\n", "utf-8")


if __name__ == "__main__":
    main()
