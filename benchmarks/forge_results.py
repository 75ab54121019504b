"""Forge results of an evaluation at random, over and over: does `verify-results` find each?

    python benchmarks/forge_results.py [--rounds N] [--seed S] [--json FILE]

Each round changes an outcome, a count, a seed or a version in the `results.json` of a small evaluation. Half
of the rounds also renew everything that follows from the change, digest included, so that only playing the
actions again can tell. A forgery is found if the verification names a contradiction or refuses the file.
"""

import argparse
import json
import random
import shutil
import tempfile
import time
from collections import Counter
from copy import deepcopy
from pathlib import Path
from typing import Any

from openvima.errors import DatasetError
from openvima.evaluation import EvaluationConfig, Results, evaluate
from openvima.evaluation.actions import ACTIONS_NAME
from openvima.evaluation.results import FILE_NAME
from openvima.evaluation.verification import verify_results
from sim import circumstances

KINDS = ("outcome", "count", "seed", "version")


def forged(content: dict[str, Any], kind: str, rng: random.Random) -> dict[str, Any]:
    """Return a copy of the content of a `results.json` with one forgery."""
    content = deepcopy(content)
    row = rng.choice(content["rows"])
    outcome = rng.choice(row["outcomes"])
    if kind == "outcome":
        name = rng.choice(("success", "steps", "resamples", "oracle_max_steps"))
        given = outcome[name] or 0
        outcome[name] = not given if name == "success" else given + rng.choice((1, 2, 5))
    elif kind == "count":
        name = rng.choice(("successes", "episodes", "rate", "mean_steps", "successes_oracle_horizon", "mean"))
        target = rng.choice(content["levels"]) if name == "mean" else row
        target[name] += rng.choice((0.1, 1, 3))
    elif kind == "seed":
        shift = rng.choice((1, 7, 1000))
        if rng.random() < 0.5:
            outcome["seed"] += shift
        else:  # all of them, consistently
            content["config"]["seed"] += shift
            for one in (one for row in content["rows"] for one in row["outcomes"]):
                one["seed"] += shift
    else:
        name = rng.choice(("mujoco", "environments"))
        content["versions"][name] += rng.choice((".1", "0"))
    return content


def forge(folder: Path, kind: str, rng: random.Random) -> None:
    """Forge the results in a folder, in half of the cases with a renewed digest."""
    path = folder / FILE_NAME
    content = forged(json.loads(path.read_text(encoding="utf-8")), kind, rng)
    path.write_text(json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    if kind != "count" and rng.random() < 0.5:
        path.write_text(Results.read(path).to_json(), encoding="utf-8")


def is_found(folder: Path) -> bool:
    """Whether the verification contradicts or refuses the results."""
    try:
        return not verify_results(folder).is_verified
    except DatasetError:
        return True


def main() -> None:
    """Forge, verify and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rng, counts, started = random.Random(options.seed), Counter(), time.perf_counter()
    tasks = ("rotate", "visual_manipulation", "sweep_without_exceeding")
    with tempfile.TemporaryDirectory() as temporary:
        whole, folder = Path(temporary) / "whole", Path(temporary) / "forged"
        evaluate(EvaluationConfig(("oracle", "random"), tasks, ("L1", "L2"), episodes=3, out=whole))
        assert verify_results(whole).is_verified
        folder.mkdir()
        shutil.copy(whole / ACTIONS_NAME, folder)
        for number in range(options.rounds):
            kind = KINDS[number % len(KINDS)]
            shutil.copy(whole / FILE_NAME, folder)
            forge(folder, kind, rng)
            counts[f"{kind}: {'found' if is_found(folder) else 'MISSED'}"] += 1
    seconds = round(time.perf_counter() - started, 1)
    record = {"rounds": options.rounds, "seed": options.seed, "counts": dict(sorted(counts.items()))}
    print(json.dumps({**record, "seconds": seconds}, indent=1))
    if options.json:
        options.json.write_text(json.dumps({**record, **circumstances()}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
