"""VIMA's and MIDAS's architectures at the cost of openvima-small.

    python experiments/openvima_small/baselines.py --data train --hours 2.5 --out baselines

They have a text encoder of their own, as openvima-small has, and are trained end to end on the same
demonstrations with the same augmentation for the same hours on the same cores. A short training measures the
time of a step; the number of steps follows. NAME.json is a record for `publish.py --baselines`. Repeating the
command resumes it.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from openvima.atomic_io import atomic_write_file
from openvima.data import Dataset
from openvima.policies.build import policy_size
from openvima.policies.checkpoint import read_info
from openvima.policies.naming import find_checkpoint
from openvima.training.run_folder import TIMINGS_FILE, read_costs, whole_lines

_TIMED_STEPS, _FIRST_STEPS = 100, 40  # the first ones load data and caches
_COMMON = (
    *("--pretraining.steps", "0", "--pretraining.attribute-loss-weight", "0", "--model.attributes", "None"),
    *("--runtime.no-tensorboard",),
)
_MIXED = ("--augmentation.inverse-dynamics-prob", "0.2")
BASELINES = {
    "vima-3m": ("VIMA", ("--preset", "vima-nano")),
    "vima-7m": ("VIMA", ("--preset", "vima-nano", "--model.width", "192", "--model.num-layers", "4")),
    "midas-8m": (
        "MIDAS, inverse dynamics mixed in",
        ("--preset", "midas-nano", "--model.width", "256", "--model.num-layers", "5", *_MIXED),
    ),
}


def main() -> None:
    """Time, train and evaluate the selected baselines."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of demonstrations")
    parser.add_argument("--out", type=Path, required=True, help="folder of runs, evaluations and records")
    parser.add_argument("--hours", type=float, required=True, help="hours of training, each")
    parser.add_argument("--only", default=",".join(BASELINES), help="names, separated by commas")
    parser.add_argument("--recipe", default="small", help="recipe of data and augmentation")
    parser.add_argument("--learning-rate", type=float, default=5e-4)
    parser.add_argument("--episodes", type=int, default=200, help="episodes per task and level")
    parser.add_argument("--seed", type=int, default=1_000_000, help="first seed of the evaluation")
    given = parser.parse_args()
    for name in given.only.split(","):
        if name not in BASELINES:
            parser.error(f"there is no baseline {name!r}; allowed: {', '.join(BASELINES)}.")
    for name in given.only.split(","):
        row = _measure(given, name)
        atomic_write_file(given.out / f"{name}.json", json.dumps(row, indent=2) + "\n")
        print(row)


def _measure(given: argparse.Namespace, name: str) -> dict[str, Any]:  # Any: plain JSON values
    what, options = BASELINES[name]
    folder, run = given.out / name, given.out / name / "run"
    rate = ("--optimizer.learning-rate", f"{given.learning_rate:g}")
    train = ("train", "--data", os.fspath(given.data), "--recipe", given.recipe, *_COMMON, *options, *rate)
    kept = folder / "steps.txt"
    if not kept.exists():
        timing = folder / "timing"
        shutil.rmtree(timing, ignore_errors=True)  # times of two sessions cannot be subtracted
        _openvima(*train, "--schedule.steps", f"{_TIMED_STEPS}", "--out", os.fspath(timing))
        per_step = seconds_per_step([values for _, values in whole_lines(timing / TIMINGS_FILE)])
        atomic_write_file(kept, f"{int(3600 * given.hours / per_step)}\n")
    steps = kept.read_text(encoding="utf-8").strip()
    _openvima(*train, "--schedule.steps", steps, "--out", os.fspath(run))
    evaluation = folder / "evaluation"
    counts = ("--episodes", f"{given.episodes}", "--seed", f"{given.seed}", "--workers", "2", "--no-report")
    _openvima("evaluate", "--policy", f"{name}={run}", *counts, "--out", os.fspath(evaluation))
    return {
        "name": name,
        "what": what,
        "demonstrations": len(Dataset(given.data)),
        "steps": int(steps),
        "learning_rate": given.learning_rate,
        "parameters": policy_size(read_info(find_checkpoint(run)).config).parameters.total,
        "minutes": round(read_costs(run)["seconds"] / 60, 1),
        "evaluation": f"{name}/evaluation/results.json",
    }


def seconds_per_step(times: list[dict[str, Any]]) -> float:  # Any: JSON
    """Return the time of a step, from the log of times of a short training."""
    first = next(each for each in times if each["step"] >= _FIRST_STEPS)
    seconds = times[-1]["seconds_since_start"] - first["seconds_since_start"]
    return seconds / (times[-1]["step"] - first["step"])


def _openvima(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "openvima", *words], check=True)


if __name__ == "__main__":
    main()
