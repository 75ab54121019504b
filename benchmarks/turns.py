"""How much faster this commit is than another: both do the same work in turns, each in a process of its own.

    python benchmarks/turns.py --base CHECKOUT [--base-python PYTHON] [--seeds N] [--repeats N] [--json FILE]

CHECKOUT is another work tree of the repository, PYTHON an interpreter with its dependencies.
`sim`: an oracle episode of a task with all images; `decisions`: prompt and observations of such an episode,
given to `openvima-small`.
After every piece of work of one process comes the same piece in the other, so that the load of the machine
hits both. Times are CPU time, the shortest of all repeats of a piece; ratios are time before over time now,
above 1 if this commit is faster.
"""

import argparse
import json
import math
import os
import subprocess
import sys
from pathlib import Path

from openvima.atomic_io import atomic_write_file
from openvima.tasks import list_tasks
from sim import FIRST_SEED, circumstances

ROOT = Path(__file__).parents[1]
NUM_WARM_UP = 2

# Runs in both checkouts; the function that plays the oracle has had two names.
WORKER = """
import sys, time
import torch
from openvima.data import records
from openvima.env import TabletopEnv
from openvima.policies import load_policy
torch.set_num_threads(1)
play = getattr(records, "rollout_oracle", None) or records.play
envs, episodes, policy = {}, {}, load_policy("openvima-small")
for line in sys.stdin:
    kind, task, seed = line.split()
    env = envs.setdefault(task, TabletopEnv(task, domain="train"))
    if kind == "decisions" and (task, seed) not in episodes:
        played = play(env, int(seed))
        episodes[task, seed] = played.prompt, [played.observation(step) for step in range(played.num_steps)]
    start = time.process_time()
    if kind == "sim":
        play(env, int(seed))
    else:
        prompt, observations = episodes[task, seed]
        policy.reset([prompt])
        for seen in observations:
            policy.act([seen])
    print(time.process_time() - start, flush=True)
"""


class Checkout:
    """A process that does pieces of work with the code of a checkout."""

    def __init__(self, python: str, root: Path) -> None:
        environment = os.environ | {"PYTHONPATH": str(root / "src"), "OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [python, "-c", WORKER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def seconds(self, piece: str) -> float:
        """Do a piece of work and return its CPU time."""
        assert self._process.stdin and self._process.stdout  # they are pipes
        print(piece, file=self._process.stdin, flush=True)
        return float(self._process.stdout.readline())


def ratio(pair: tuple[Checkout, Checkout], kind: str, task: str, seeds: range, repeats: int) -> float:
    """Return the time of the first checkout over that of the second."""
    best = [[math.inf, math.inf] for _ in seeds]
    for _ in range(NUM_WARM_UP):
        for checkout in pair:
            checkout.seconds(f"{kind} {task} {seeds[0]}")
    for _ in range(repeats):
        for seed, times in zip(seeds, best, strict=True):
            for side, checkout in enumerate(pair):
                times[side] = min(times[side], checkout.seconds(f"{kind} {task} {seed}"))
    return sum(base for base, _ in best) / sum(own for _, own in best)


def main() -> None:
    """Measure, print a table, and write JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--base", type=Path, required=True, help="work tree of the commit before")
    parser.add_argument("--base-python", default=sys.executable, help="interpreter for it")
    parser.add_argument("--tasks", default="all", help="names with commas between them, or 'all'")
    parser.add_argument("--seeds", type=int, default=6, help="episodes of a task")
    parser.add_argument("--repeats", type=int, default=5, help="of each piece of work")
    parser.add_argument("--json", type=Path, help="file to write")
    given = parser.parse_args()
    tasks = list_tasks() if given.tasks == "all" else given.tasks.split(",")
    seeds = range(FIRST_SEED, FIRST_SEED + given.seeds)
    pair = Checkout(given.base_python, given.base.resolve()), Checkout(sys.executable, ROOT)
    found: dict[str, dict[str, float]] = {"sim": {}, "decisions": {}}
    for task in tasks:
        for kind, ratios in found.items():
            ratios[task] = round(ratio(pair, kind, task, seeds, given.repeats), 3)
        print(
            f"{task:28}  sim {found['sim'][task]:.2f}  decisions {found['decisions'][task]:.2f}", flush=True
        )
    means = {kind: round(math.prod(r.values()) ** (1 / len(tasks)), 3) for kind, r in found.items()}
    print(f"{'geometric mean':28}", *(f"{kind} {mean:.2f}" for kind, mean in means.items()))
    if given.json:
        base = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=given.base, capture_output=True, text=True
        ).stdout.strip()
        result = {"base_commit": base, "ratios": found, "geometric_means": means, **circumstances()}
        atomic_write_file(given.json, json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
