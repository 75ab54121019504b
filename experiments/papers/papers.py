"""The papers' table from trainings of this package: VIMA, its baselines and MIDAS in size nano.

    openvima generate --tasks all --episodes 4000 --workers 2 --out train
    python experiments/papers/papers.py --data train --out papers --only vima,midas

Each run is one `openvima train` with its default recipe and one `openvima evaluate`; repeating the command
resumes. Options that are not this script's are given to every training, such as --schedule.steps 3000.
NAME.json in --out is the record of a run: options, costs, learning curve, successes by task and level. The
table of all records there is written to --out/table.md.
"""

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from openvima.atomic_io import atomic_write_file
from openvima.evaluation.statistics import mean_of_rates
from openvima.policies.build import count_parameters, outline_network
from openvima.policies.checkpoint import read_info
from openvima.policies.naming import METRICS_FILE, find_checkpoint
from openvima.training.run_folder import SESSIONS_FILE, read_costs, read_lines

LEVELS = ("L1", "L2", "L3", "L4")
# Name of a run to what it is, and its options.
RUNS: dict[str, tuple[str, tuple[str, ...]]] = {
    "vima": ("VIMA", ("--preset", "vima-nano")),
    "vima-1": ("VIMA, second seed", ("--preset", "vima-nano", "--seed", "1")),
    "vima-plain": (
        "VIMA, no random appearance",
        ("--preset", "vima-nano", "--loader.rerendered-prob", "0"),
    ),
    "vima-baselines": (
        "VIMA, recipe of the baselines",
        ("--preset", "vima-nano", "--recipe", "papers-frames"),
    ),
    "gato": ("VIMA-Gato", ("--preset", "gato-nano")),
    "flamingo": ("VIMA-Flamingo", ("--preset", "flamingo-nano")),
    "gpt": ("VIMA-GPT", ("--preset", "gpt-nano")),
    "midas-plain": (
        "MIDAS, no inverse dynamics",
        ("--preset", "midas-nano", "--augmentation.inverse-dynamics-prob", "0"),
    ),
    "midas": ("MIDAS, inverse dynamics mixed in", ("--preset", "midas-nano")),
    "midas-1": ("MIDAS, second seed", ("--preset", "midas-nano", "--seed", "1")),
}


def main() -> None:
    """Train and evaluate the selected runs, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of demonstrations")
    parser.add_argument("--out", type=Path, required=True, help="folder of runs, evaluations and records")
    parser.add_argument("--only", default=",".join(RUNS), help="names, separated by commas")
    parser.add_argument("--episodes", type=int, default=100, help="episodes per task and level")
    parser.add_argument("--seed", type=int, default=4_000_000, help="first seed of the evaluation")
    given, for_all = parser.parse_known_args()
    if unknown := [name for name in given.only.split(",") if name not in RUNS]:
        parser.error(f"there is no run {unknown[0]!r}; allowed: {', '.join(RUNS)}.")
    for name in given.only.split(","):
        what, options = RUNS[name]
        run, scores = given.out / name / "run", given.out / name / "evaluation"
        common = ("--data", os.fspath(given.data), "--runtime.no-tensorboard")
        openvima("train", *common, *options, *for_all, "--out", os.fspath(run))
        counts = ("--episodes", f"{given.episodes}", "--seed", f"{given.seed}", "--workers", "2")
        openvima(
            *("evaluate", "--policy", f"{name}={run}", *counts, "--no-report", "--out", os.fspath(scores))
        )
        record = record_of(what, run, scores, options=[*options, *for_all])
        atomic_write_file(given.out / f"{name}.json", json.dumps(record, indent=1) + "\n")
    records = [json.loads(path.read_text("utf-8")) for path in sorted(given.out.glob("*.json"))]
    atomic_write_file(given.out / "table.md", table(records))
    print(given.out / "table.md")


def record_of(what: str, run: Path, scores: Path, *, options: list[str]) -> dict[str, Any]:
    """Return the record of one training and its evaluation, as plain JSON values."""
    results = json.loads((scores / "results.json").read_text("utf-8"))
    curve = [values for values in read_lines(run / METRICS_FILE) if "validation_loss" in values]
    shares = (f"validation_{part}_accuracy" for part in ("object", "pick", "place", "rotation"))
    keys = ("step", "validation_loss", *shares)
    costs = read_costs(run)
    return {
        "what": what,
        "options": options,
        "commits": sorted({values["git"]["commit"] for values in read_lines(run / SESSIONS_FILE)}),
        "parameters": count_parameters(outline_network(read_info(find_checkpoint(run)).config))[
            "total"
        ].total,
        "minutes": round(costs["seconds"] / 60, 1),
        "steps": curve[-1]["step"],
        "curve": [{key: round(line[key], 4) for key in keys if key in line} for line in curve],
        "rows": [
            {key: row[key] for key in ("task", "level", "successes", "episodes")} for row in results["rows"]
        ],
    }


def level_score(rows: list[dict[str, Any]], level: str) -> str:
    """Return the mean success of a level over its tasks in %, with its 95% interval."""
    counts = [(row["successes"], row["episodes"]) for row in rows if row["level"] == level]
    mean, (low, high) = mean_of_rates(counts)
    return f"{100 * mean:.1f} ({100 * low:.1f} to {100 * high:.1f})"


def table(records: list[dict[str, Any]]) -> str:
    """Return Markdown: a line a run by level, and one a task at L1."""
    lines = [
        "|  | parameters | steps | minutes | " + " | ".join(LEVELS) + " |",
        "|---|---:|---:|---:|" + "---:|" * len(LEVELS),
    ]
    for record in records:
        scores = " | ".join(level_score(record["rows"], level) for level in LEVELS)
        size = f"{record['parameters'] / 1e6:.1f}M | {record['steps']:,} | {record['minutes']:.0f}"
        lines.append(f"| {record['what']} | {size} | {scores} |")
    tasks = sorted({(row["level"], row["task"]) for record in records for row in record["rows"]})
    lines += ["", "|  | " + " | ".join(record["what"] for record in records) + " |"]
    lines.append("|---|" + "---:|" * len(records))
    for level, task in tasks:
        found = [
            next((row for row in record["rows"] if (row["level"], row["task"]) == (level, task)), None)
            for record in records
        ]
        cells = [f"{100 * row['successes'] / row['episodes']:.0f}" if row else "–" for row in found]
        lines.append(f"| {level} {task} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def openvima(*words: str) -> None:
    """Run a command of the package."""
    subprocess.run([sys.executable, "-m", "openvima", *words], check=True)


if __name__ == "__main__":
    main()
