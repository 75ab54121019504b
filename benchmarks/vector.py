"""Vector environments against single ones: steps a second, in alternating rounds.

    python benchmarks/vector.py [--tasks a,b] [--num-envs N] [--steps N] [--workers 0,1,2] [--rounds N]

Sub-environment i plays one task with seeds of its own, by actions of the oracle that were recorded before; an
ended episode is followed by the next, whose start counts as a step. The single environments play the same
episodes, one sub-environment after the other, so that the work is the same to the step. The first half of the
steps is not timed: workers load textures and compiled code in it. This process forgets the models of earlier
rounds, which play the same episodes: workers are new processes and have none.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import openvima
from openvima.env import stack_actions
from openvima.scene import Action
from openvima.sim.model import build_model
from sim import circumstances


def record(task: str, index: int, num_envs: int, steps: int) -> list[Action | None]:
    """Return what a sub-environment does in each step; None starts its next episode."""
    env, seed, actions = openvima.make(task), index, []
    env.reset(seed=seed)
    is_over = False
    while len(actions) < steps:
        if is_over:
            seed += num_envs
            env.reset(seed=seed)
            actions.append(None)
            is_over = False
        else:
            actions.append(env.oracle_decision().action)
            *_, terminated, truncated, _ = env.step(actions[-1])
            is_over = terminated or truncated
    return actions


def time_single(tasks: Sequence[str], plans: Sequence[Sequence[Action | None]]) -> float:
    """Return the seconds that single environments take for the second half of the steps."""
    build_model.cache_clear()
    envs = [openvima.make(tasks[index % len(tasks)]) for index in range(len(plans))]
    for index, env in enumerate(envs):
        env.reset(seed=index)
    seeds, half = list(range(len(plans))), len(plans[0]) // 2
    for part in (slice(half), slice(half, None)):
        started = time.perf_counter()
        for index, (env, plan) in enumerate(zip(envs, plans, strict=True)):
            for action in plan[part]:
                if action is None:
                    seeds[index] += len(plans)
                    env.reset(seed=seeds[index])
                else:
                    env.step(action)
    return time.perf_counter() - started


def time_batch(tasks: Sequence[str], plans: Sequence[Sequence[Action | None]], num_workers: int) -> float:
    """Return the seconds that a vector environment takes for the second half of the steps."""
    build_model.cache_clear()
    num_seeds = len(plans) * (len(plans[0]) + 1)
    envs = openvima.make_vec(list(tasks), len(plans), num_workers=num_workers, seeds=range(num_seeds))
    try:
        envs.reset()
        batches = [stack_actions(actions) for actions in zip(*plans, strict=True)]
        for batch in batches[: len(batches) // 2]:
            envs.step(batch)
        started = time.perf_counter()
        for batch in batches[len(batches) // 2 :]:
            envs.step(batch)
        return time.perf_counter() - started
    finally:
        envs.close()


def main() -> None:
    """Print the rates and their ratios to single environments; write them to --json."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--tasks", default=",".join(openvima.list_tasks()))
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--workers", default="0,1,2")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    tasks, workers = given.tasks.split(","), [int(number) for number in given.workers.split(",")]
    plans = [record(tasks[i % len(tasks)], i, given.num_envs, given.steps) for i in range(given.num_envs)]
    seconds: dict[str, list[float]] = {}
    for _ in range(given.rounds):
        seconds.setdefault("single", []).append(time_single(tasks, plans))
        for number in workers:
            seconds.setdefault(f"{number} workers", []).append(time_batch(tasks, plans, number))
    rows = {}
    for name, times in seconds.items():
        ratios = [one / other for one, other in zip(seconds["single"], times, strict=True)]
        rows[name] = {
            "steps_per_s": round(
                given.num_envs * (given.steps - given.steps // 2) / statistics.median(times), 1
            ),
            "ratio_to_single": round(statistics.median(ratios), 3),
            "ratios": [round(ratio, 3) for ratio in ratios],
        }
        low, high = min(ratios), max(ratios)
        print(
            f"{name:>10}  {rows[name]['steps_per_s']:8.1f} steps/s  "
            f"{rows[name]['ratio_to_single']:.2f} of single ({low:.2f} to {high:.2f})"
        )
    if given.json:
        settings = {key: value for key, value in vars(given).items() if key != "json"}
        given.json.write_text(json.dumps(circumstances() | {"settings": settings, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
