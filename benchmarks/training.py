"""How much faster a training step is than in another checkout: both do the same steps in turns.

    python benchmarks/training.py --base CHECKOUT --data DIR [--presets NAME,…] [--rounds N] [--json FILE]

Behaviour cloning of 64 demonstrations of all tasks in DIR on one core, forward, backward and AdamW, without
pretraining. Times are CPU time of a step, the median of all rounds; the ratio is time before over time now.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

from openvima.atomic_io import atomic_write_file
from sim import circumstances

ROOT = Path(__file__).parents[1]
STEPS = 10  # of a round
WORKER = """
import sys, time
from pathlib import Path
import torch
torch.set_num_threads(1)
from openvima.data.object_cache import open_object_cache
from openvima.data.reader import Dataset
from openvima.training.behaviour_cloning import BehaviourCloning
from openvima.training.building import build_learner, resolved
from openvima.training.config import TrainingConfig
from openvima.training.parallel import ONE_PROCESS
from openvima.training.source import split_examples
from openvima.training.building import training_texts
data, preset, steps = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
settings = {"data": data, "out": Path("run"), "preset": preset, "optimizer.learning_rate": 3e-4}
if preset == "small":
    settings["pretraining.attribute_loss_weight"] = 0.5
config, dataset = resolved(TrainingConfig.of(settings)), Dataset(data)
learner = build_learner(config, training_texts(dataset, config.augmentation, with_captions=preset == "small"))
training, validation = split_examples(
    open_object_cache(dataset), validation_fraction=0.02, validation_episodes=64)
stage = BehaviourCloning(learner, learner, config, training, validation, ONE_PROCESS)
optimizer = torch.optim.AdamW(stage.parameters, lr=3e-4, fused=True)
learner.train()
number = 0
for line in sys.stdin:
    start = time.process_time()
    for _ in range(steps):
        optimizer.zero_grad()
        stage.backward(number)
        optimizer.step()
        number += 1
    print((time.process_time() - start) / steps, flush=True)
"""


def measure(base: Path, data: Path, preset: str, rounds: int) -> dict[str, float]:
    """Return the seconds of a step in the other checkout and in this one, and their ratio."""
    workers = [_worker(root, data, preset) for root in (base, ROOT)]
    times: list[list[float]] = [[], []]
    for number in range(rounds + 1):
        for worker, found in zip(workers, times, strict=True):
            assert worker.stdin is not None and worker.stdout is not None
            worker.stdin.write("go\n")
            worker.stdin.flush()
            seconds = float(worker.stdout.readline())
            if number:  # the first round warms up
                found.append(seconds)
    for worker in workers:
        worker.communicate()
    before, now = map(statistics.median, times)
    return {"seconds_before": round(before, 4), "seconds": round(now, 4), "ratio": round(before / now, 3)}


def _worker(root: Path, data: Path, preset: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-c", WORKER, os.fspath(data), preset, str(STEPS)],
        env={**os.environ, "PYTHONPATH": os.fspath(root / "src")},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--base", type=Path, required=True, help="checkout to compare with")
    parser.add_argument("--data", type=Path, required=True, help="demonstrations")
    parser.add_argument("--presets", default="vima-nano,midas-nano,small", help="separated by commas")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--json", type=Path, help="file to write")
    given = parser.parse_args()
    found = {
        name: measure(given.base, given.data.resolve(), name, given.rounds)
        for name in given.presets.split(",")
    }
    text = json.dumps({**circumstances(), "presets": found}, indent=2) + "\n"
    print(text)
    if given.json:
        atomic_write_file(given.json, text)


if __name__ == "__main__":
    main()
