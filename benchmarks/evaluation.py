"""How many evaluation episodes a second one core plays with a network, and where the time goes.

    python benchmarks/evaluation.py [--quick] [--precision P] [--rounds R] [--json FILE]

Batches of 1, 8 and 32 environments of one task are played as `openvima evaluate` plays them, with the small
policy and one of 20 million parameters (and T5-base, which reads its prompts). Weights are random and words
are numbered by a hash: neither changes the time of a decision, but hardly any episode is solved, so episodes
take more steps than those of a trained policy; decisions a second say more. Environments are built anew for
each batch, and job and outcomes are pickled, as between processes.

Rates are measured without timers inside, in alternating rounds after one that warms up; a separate pass
divides the time into simulation with rendering, finding objects in images, networks, and the rest: copying,
padding and pickling.
"""

import argparse
import json
import os
import pickle
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch

from openvima.env import TabletopEnv
from openvima.env.config import EnvConfig
from openvima.evaluation.config import PRECISIONS, Batch
from openvima.evaluation.results import EpisodeOutcome
from openvima.evaluation.rollout import play
from openvima.evaluation.rollout_policies import PromptedRolloutPolicy
from openvima.evaluation.runner import Job
from openvima.policies.inference import NetworkPolicy
from openvima.policies.processor import Processor
from openvima.render.rasteriser import Rasteriser
from policy import random_network, tokenizer_of
from sim import circumstances

POLICIES = ("nano", "vima-20m")
QUICK_POLICIES = ("nano", "vima-2m")
NUM_ENVS = (1, 8, 32)
TASKS = ("visual_manipulation", "rearrange", "sweep_without_exceeding")  # short, long, and with the spatula
LEVEL = "L1"
MIN_EPISODES = 4  # of a task in one round, where a batch is smaller
OTHER = "transfer"
PHASES: dict[str, list[tuple[Any, str]]] = {  # phase → owner and name of its functions, but for inference
    "simulation": [(EnvConfig, "make"), (TabletopEnv, "reset"), (TabletopEnv, "step")],
    "rendering": [(Rasteriser, "scene"), (Rasteriser, "prompt")],
    "seeing": [(Processor, "encode_prompts"), (Processor, "encode_observations")],
}
INFERENCE = ("encode_images", "encode_prompt", "decode_step")  # methods of the network


@contextmanager
def timed_phases(policy: NetworkPolicy) -> Iterator[dict[str, float]]:
    """Time the functions of `PHASES` and the network; yields seconds by phase, each counted once."""
    seconds = dict.fromkeys((*PHASES, "inference", OTHER), 0.0)
    running, since = [OTHER], time.perf_counter()

    def switch() -> None:
        nonlocal since
        now = time.perf_counter()
        seconds[running[-1]] += now - since
        since = now

    def timed(phase: str, function: Callable) -> Callable:
        def wrapper(*args: object, **options: object) -> object:
            switch()
            running.append(phase)
            try:
                return function(*args, **options)
            finally:
                switch()
                running.pop()

        return wrapper

    parts = [(phase, *part) for phase, found in PHASES.items() for part in found]
    parts += [("inference", type(policy.network), name) for name in INFERENCE]
    originals = [getattr(owner, name) for _, owner, name in parts]
    for (phase, owner, name), original in zip(parts, originals, strict=True):
        setattr(owner, name, timed(phase, original))
    try:
        yield seconds
        switch()
    finally:
        for (_, owner, name), original in zip(parts, originals, strict=True):
            setattr(owner, name, original)


def play_batches(policy: NetworkPolicy, num_envs: int, first_seed: int) -> list[EpisodeOutcome]:
    """Play some batches of each task."""
    outcomes: list[EpisodeOutcome] = []
    for task in TASKS:
        for offset in range(0, max(num_envs, MIN_EPISODES), num_envs):
            outcomes += play_one(policy, Batch("run", "run", task, LEVEL, first_seed + offset, num_envs))
    return outcomes


def play_one(policy: NetworkPolicy, batch: Batch) -> Sequence[EpisodeOutcome]:
    """Play a batch as a worker process does."""
    batch = pickle.loads(pickle.dumps(Job(batch, ""))).batch
    envs = [batch.env_config.make(batch.task, batch.level, domain="eval") for _ in batch.seeds]
    return pickle.loads(pickle.dumps(tuple(play(envs, batch.seeds, PromptedRolloutPolicy(policy)))))


def measure(name: str, precision: str, sizes: Sequence[int], num_rounds: int) -> dict[str, dict[str, Any]]:
    """Measure one policy with each number of environments."""
    network = random_network(name)
    policy = NetworkPolicy(network, tokenizer=tokenizer_of(network), dtype=getattr(torch, precision))
    rounds: dict[int, list[tuple[float, float]]] = {size: [] for size in sizes}
    for number in range(num_rounds + 1):
        for size in sizes if number else sizes[:1]:
            start = time.perf_counter()
            outcomes = play_batches(policy, size, 1000 * number)
            seconds = time.perf_counter() - start
            if number:
                decisions = sum(outcome.steps for outcome in outcomes)
                rounds[size].append((len(outcomes) / seconds, decisions / seconds))
    return {str(size): summary(rounds[size]) | shares(policy, size) for size in sizes}


def summary(rates: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Return medians of the rates, and the range."""
    episodes, decisions = zip(*rates, strict=True)
    return {
        "episodes_per_s": round(statistics.median(episodes), 3),
        "slowest_round": round(min(episodes), 3),
        "fastest_round": round(max(episodes), 3),
        "decisions_per_s": round(statistics.median(decisions), 2),
    }


def shares(policy: NetworkPolicy, num_envs: int) -> dict[str, float]:
    """Return each phase's share of the time; the simulation's share includes that of rendering."""
    with timed_phases(policy) as seconds:
        play_batches(policy, num_envs, 1000)
    total = sum(seconds.values())
    seconds["simulation"] += seconds["rendering"]
    return {f"share_{phase}": round(value / total, 4) for phase, value in seconds.items()}


def table(results: dict[str, dict[str, dict[str, Any]]]) -> str:
    """Return the results as lines of text."""
    phases = [f"share_{phase}" for phase in (*PHASES, OTHER)]
    head = f"{'policy':<12}{'envs':>6}{'eps/s':>9}{'range':>15}{'decisions/s':>13}"
    lines = [head + "".join(f"{phase.removeprefix('share_'):>12}" for phase in phases)]
    for name, sizes in results.items():
        for size, entry in sizes.items():
            spread = f"{entry['slowest_round']:.2f}–{entry['fastest_round']:.2f}"
            cells = "".join(f"{100 * entry[phase]:>10.1f} %" for phase in phases)
            rate, decisions = entry["episodes_per_s"], entry["decisions_per_s"]
            lines.append(f"{name:<12}{size:>6}{rate:>9.2f}{spread:>15}{decisions:>13.1f}{cells}")
    return "\n".join([*lines, "The share of simulation includes that of rendering."])


def main() -> None:
    """Measure, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--quick", action="store_true", help="a smaller policy and fewer environments")
    parser.add_argument("--precision", choices=PRECISIONS, default="float64", help="that of the networks")
    parser.add_argument(
        "--rounds", type=int, default=3, help="alternating rounds, after a first that warms up"
    )
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    torch.set_num_threads(1)
    where = circumstances() | {
        "torch": torch.__version__,
        "threads": 1,
        "rounds": options.rounds,
        "precision": options.precision,
        "tasks": list(TASKS),
    }
    print(", ".join(f"{name}: {value}" for name, value in where.items()))
    policies, sizes = (QUICK_POLICIES, NUM_ENVS[:2]) if options.quick else (POLICIES, NUM_ENVS)
    results = {name: measure(name, options.precision, sizes, options.rounds) for name in policies}
    print(table(results))
    if options.json:
        content = {"policies": results, **where}
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
