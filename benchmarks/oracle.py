"""Success of the oracle on the evaluation episodes of each task and level.

    python benchmarks/oracle.py [--episodes N] [--workers K] [--levels L1,L2,…] [--seed S]
                                [--control end_effector] [--out DIR] [--record]

Runs them with `openvima evaluate` (resumable), prints every failure with its seed and reason, and with
`--record` writes the counts for `openvima tasks`.
"""

import argparse
import json
from pathlib import Path

from openvima.catalog import LEVELS
from openvima.env import EnvConfig
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.scene.action import CONTROLS, PRIMITIVES

RECORD = Path(__file__).parents[1] / "src/openvima/tasks/oracle_success.json"


def counts(results: Results) -> dict[str, dict[str, dict[str, int]]]:
    """Return task → level → episodes, successes and resamples."""
    found: dict[str, dict[str, dict[str, int]]] = {}
    for row in sorted(results.rows, key=lambda row: (row.task, LEVELS.index(row.level))):
        entry = {"episodes": row.episodes, "successes": row.successes, "resamples": row.resamples}
        found.setdefault(row.task, {})[row.level] = entry
    return found


def main() -> None:
    """Play, print, and record if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--tasks", default="all")
    parser.add_argument("--levels", default=",".join(LEVELS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--control", choices=CONTROLS, default=PRIMITIVES)
    parser.add_argument("--out", type=Path, default=Path("oracle"))
    parser.add_argument("--record", action="store_true")
    options = parser.parse_args()
    for name in ("episodes", "tasks", "levels", "seed", "control"):
        if options.record and getattr(options, name) != parser.get_default(name):
            parser.error(f"--record replaces the counts of all tasks; leave out --{name}.")
    config = EvaluationConfig(
        policies=("oracle",),
        tasks=tuple(options.tasks.split(",")),
        levels=tuple(options.levels.split(",")),
        episodes=options.episodes,
        workers=options.workers,
        out=options.out,
        batch=50,
        seed=options.seed,
        env_config=EnvConfig(control=options.control),
    )
    results = Results.read(evaluate(config))
    found = counts(results)
    for task, levels in found.items():
        cells = "   ".join(f"{level} {e['successes']}/{e['episodes']}" for level, e in levels.items())
        resamples = sum(entry["resamples"] for entry in levels.values())
        print(f"{task:<28}{cells}   resamples {resamples}")
    for row in results.rows:
        for outcome in row.outcomes:
            if not outcome.success:
                print(f"failed: {row.task} {row.level} seed {outcome.seed}: {outcome.reason}")
    if options.record:
        record = {
            "command": "python benchmarks/oracle.py --record",
            "versions": results.versions,
            "tasks": found,
        }
        RECORD.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
