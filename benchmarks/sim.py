"""How many oracle episodes a second one core simulates and draws, task by task, and where the time goes.

    python benchmarks/sim.py [--episodes N] [--tasks a,b|all] [--rounds R] [--json FILE]

An episode is what a demonstration holds: sampling, all prompt images, every action of the oracle with its
physics, and RGB and segmentation of both views before the first action and after each. Nothing is written.
The rate is measured without timers inside; a separate pass, with timers, divides the time into phases.
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

from openvima.data.records import package_versions, rollout_oracle
from openvima.env import TabletopEnv, tabletop
from openvima.env.running_episode import PrimitiveRun
from openvima.errors import OracleError, SamplingError
from openvima.render.rasteriser import Rasteriser
from openvima.sim.world import World
from openvima.tasks import list_tasks

NUM_WARM_UP = 10  # episodes: compiles or loads the kernels, fills the caches of shapes and textures
FIRST_SEED = 1_000_000
PHASES: dict[str, tuple[Any, str]] = {  # phase → owner and name of the function that it consists of
    "sampling": (tabletop, "sample_episode"),
    "model_building": (PrimitiveRun, "build_world"),
    "physics": (World, "execute"),
    "oracle": (tabletop, "oracle_action"),
    "observations": (Rasteriser, "scene"),
    "prompt_images": (Rasteriser, "prompt"),
}


def play(env: TabletopEnv, seed: int) -> int:
    """Run one episode; return the number of its steps, 0 if it could not be played."""
    with suppress(SamplingError, OracleError):
        return rollout_oracle(env, seed).num_steps
    return 0


def rate(env: TabletopEnv, num_episodes: int, first_seed: int) -> tuple[float, float]:
    """Play episodes; return episodes a second and mean steps an episode."""
    start = time.perf_counter()
    num_steps = sum(play(env, first_seed + k) for k in range(num_episodes))
    return num_episodes / (time.perf_counter() - start), num_steps / num_episodes


@contextmanager
def timed_phases() -> Iterator[dict[str, float]]:
    """Time the functions of `PHASES` while the block runs; yields seconds by phase."""
    seconds = dict.fromkeys(PHASES, 0.0)
    originals = {phase: getattr(owner, name) for phase, (owner, name) in PHASES.items()}

    def timed(phase: str, function: Callable) -> Callable:
        def wrapper(*args: object, **options: object) -> object:
            start = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                seconds[phase] += time.perf_counter() - start

        return wrapper

    for phase, (owner, name) in PHASES.items():
        setattr(owner, name, timed(phase, originals[phase]))
    try:
        yield seconds
    finally:
        for phase, (owner, name) in PHASES.items():
            setattr(owner, name, originals[phase])


def phases_ms(env: TabletopEnv, num_episodes: int, first_seed: int) -> dict[str, float]:
    """Return milliseconds an episode by phase; "other" is what no phase covers."""
    start = time.perf_counter()
    with timed_phases() as seconds:
        for k in range(num_episodes):
            play(env, first_seed + k)
    total = time.perf_counter() - start
    seconds["other"] = total - sum(seconds.values())
    return {phase: round(1000 * s / num_episodes, 3) for phase, s in seconds.items()}


def measure(tasks: list[str], num_episodes: int, num_rounds: int) -> dict[str, dict[str, Any]]:
    """Measure all tasks in alternating rounds; the rate is the median of the rounds."""
    envs = {task: TabletopEnv(task, domain="train") for task in tasks}
    for env in envs.values():
        rate(env, NUM_WARM_UP, FIRST_SEED)
    rounds: dict[str, list[tuple[float, float]]] = {task: [] for task in tasks}
    for number in range(num_rounds):
        for task, env in envs.items():
            rounds[task].append(rate(env, num_episodes, FIRST_SEED + number * num_episodes))
    results = {}
    for task, env in envs.items():
        rates = [r for r, _ in rounds[task]]
        results[task] = {
            "episodes_per_s": round(statistics.median(rates), 2),
            "slowest_round": round(min(rates), 2),
            "fastest_round": round(max(rates), 2),
            "steps_per_episode": round(statistics.mean(s for _, s in rounds[task]), 3),
            "phases_ms": phases_ms(env, num_episodes, FIRST_SEED),
        }
    return results


def circumstances() -> dict[str, Any]:
    """Return machine, versions and commit."""
    command = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True, check=False)
    model = platform.processor() or platform.machine()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        model = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), model)
    return {
        "machine": f"{model}, {os.cpu_count()} cores, {platform.system()}",
        "load_average": round(os.getloadavg()[0], 2),
        "python": platform.python_version(),
        "versions": package_versions(),
        "commit": commit.stdout.strip() or "unknown",
    }


def table(results: dict[str, dict[str, Any]], geomean: float) -> str:
    """Return the results as lines of text."""
    columns = [*PHASES, "other"]
    head = f"{'task':<28}{'eps/s':>8}{'range':>16}{'steps':>7}" + "".join(f"{c:>16}" for c in columns)
    lines = [head + "   (ms an episode)"]
    for task, entry in results.items():
        spread = f"{entry['slowest_round']:.1f}–{entry['fastest_round']:.1f}"
        cells = "".join(f"{entry['phases_ms'][c]:>16.2f}" for c in columns)
        lines.append(
            f"{task:<28}{entry['episodes_per_s']:>8.1f}{spread:>16}{entry['steps_per_episode']:>7.2f}{cells}"
        )
    return "\n".join([*lines, f"geometric mean: {geomean:.1f} episodes/s on one core"])


def main() -> None:
    """Measure, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--episodes", type=int, default=100, help="episodes of a task in one round")
    parser.add_argument("--rounds", type=int, default=3, help="rounds over all tasks")
    parser.add_argument("--tasks", default="all", help="names with commas between them, or 'all'")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    tasks = list(list_tasks()) if options.tasks == "all" else options.tasks.split(",")
    where = circumstances()
    print(", ".join(f"{name}: {value}" for name, value in where.items()))
    results = measure(tasks, options.episodes, options.rounds)
    rates = [entry["episodes_per_s"] for entry in results.values()]
    geomean = statistics.geometric_mean(rates)
    print(table(results, geomean))
    if options.json:
        content = {"geomean": round(geomean, 2), "tasks": results, **where}
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
