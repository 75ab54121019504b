"""How many episodes are sampled in a second, task by task, on one core: no physics, no images.

    python benchmarks/sampling.py [--tasks a,b] [--assets procedural|CHECKOUT] [--episodes N] [--json FILE]

Tasks take turns in each round, and every round has seeds of its own. Compilation and the making of shapes are
not counted.
"""

import argparse
import json
import os
import statistics
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

from openvima.catalog import Assets
from openvima.catalog.packs import load_assets
from openvima.tasks import list_tasks, sample_episode, task_spec
from sim import circumstances


def measure(
    tasks: list[str], assets: Assets, *, num_episodes: int, num_rounds: int
) -> dict[str, dict[str, float]]:
    """Return, for each task, episodes a second (median and extremes over rounds) and redraws an episode."""
    rates: dict[str, list[float]] = {task: [] for task in tasks}
    redraws = dict.fromkeys(tasks, 0)
    for round_number in range(num_rounds + 1):
        seeds = range(round_number * num_episodes, (round_number + 1) * num_episodes)
        for task in tasks:
            level = task_spec(task).levels[0]
            start = time.perf_counter()
            episodes = [sample_episode(task, level=level, seed=seed, assets=assets) for seed in seeds]
            elapsed = time.perf_counter() - start
            if round_number:  # the first one warms up
                rates[task].append(num_episodes / elapsed)
                redraws[task] += sum(episode.num_redraws for episode in episodes)
    return {
        task: {
            "episodes_per_s": statistics.median(values),
            "slowest_round": min(values),
            "fastest_round": max(values),
            "redraws_per_episode": redraws[task] / (num_rounds * num_episodes),
        }
        for task, values in rates.items()
    }


def main() -> None:
    """Measure, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--tasks", default="all", help="names with commas between, or all")
    parser.add_argument("--assets", default="procedural", help="procedural, or a checkout of VIMABench")
    parser.add_argument("--episodes", type=int, default=200, help="episodes of each task in a round")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, help="file to write the result to")
    arguments = parser.parse_args()
    tasks = list(list_tasks()) if arguments.tasks == "all" else arguments.tasks.split(",")
    assets = load_assets(arguments.assets)
    rows = measure(tasks, assets, num_episodes=arguments.episodes, num_rounds=arguments.rounds)
    print(f"episodes a second, pack {assets.name}")
    print(f"{'task':30} {'median':>8} {'slowest':>8} {'fastest':>8} {'redraws':>8}")
    for task, row in rows.items():
        print(
            f"{task:30} {row['episodes_per_s']:8.0f} {row['slowest_round']:8.0f} {row['fastest_round']:8.0f} "
            f"{row['redraws_per_episode']:8.4f}"
        )
    geomean = statistics.geometric_mean(row["episodes_per_s"] for row in rows.values())
    print(f"geometric mean: {geomean:.0f}")
    if arguments.json:
        result = {"geomean": geomean, "assets": assets.name, "tasks": rows, **circumstances()}
        arguments.json.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
