"""How much faster this commit is than another: both do the same work in turns, each in a process of its own.

    python benchmarks/turns.py --base CHECKOUT [--seeds N] [--repeats N] [--json FILE]
    python benchmarks/turns.py --base CHECKOUT --data DIR [--presets NAME,…] [--repeats N] [--json FILE]
    python benchmarks/turns.py --base CHECKOUT --command "evaluate --episodes 5" [--repeats N] [--json FILE]

CHECKOUT is another work tree of the repository.
`sim`: an oracle episode of a task with all images; `decisions`: prompt and observations of such an episode,
given to `openvima-small`.
With a folder of demonstrations: `batches`, all of its object cache as padded batches of 128 with images, and
`batches_without_images`; `writing`, a shard of its first 100 demonstrations; `opening`, the first episodes of
up to 100 shards, the index read before; `reading`, the next ones of the same shards.
With `--presets`: training steps of 64 of these demonstrations, forward, backward and AdamW.
With `--command`: a whole command from its start to its end.
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
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from openvima.atomic_io import atomic_write_file
from openvima.tasks import list_tasks
from sim import FIRST_SEED, circumstances

ROOT = Path(__file__).parents[1]
NUM_WARM_UP = 2

Ratios = dict[str, dict[str, float]]

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

# Likewise, for what is done with demonstrations.
DATA_WORKER = """
import sys, tempfile, time
from pathlib import Path
import pyarrow as pa
import torch
from openvima.data import Dataset, ShardWriter
from openvima.policies.processor import Processor
try:
    from openvima.data.object_cache import open_object_cache
    from openvima.data.preprocessed import number_images
    from openvima.training.batches import BatchOrder
except ImportError:  # of an older checkout
    from openvima.data.batching import BatchOrder
    from openvima.data.object_cache.cache import open_object_cache
torch.set_num_threads(1)
pa.set_cpu_count(1)
folder = sys.argv[1]
dataset = Dataset(folder)
cache, processor = open_object_cache(dataset), Processor("objects")
order = BatchOrder(len(cache), 128, lengths=cache.lengths())
batches = [order.rows(number) for number in range(order.batches_per_epoch)]
demos = [dataset[row] for row in range(min(100, len(dataset)))]
info = dataset.shard(dataset.shard_names()[0]).info
rows = {}
for row in range(len(dataset)):
    rows.setdefault(dataset.locate(row)[0], []).append(row)
rows = [both[:2] for both in rows.values() if len(both) > 1][:100]
columns = ["rgb_front", "rgb_top", "segm_front", "segm_top", "prompt", "pose0_position", "pose1_position"]

def read_batch(indices, images):
    if hasattr(cache, "batch"):
        episodes = cache.batch(indices)
        own = episodes.images, episodes.num_images
    else:
        episodes = number_images([cache[row] for row in indices.tolist()])
        own = ([episode.images for episode in episodes],)
    made = processor.collate(episodes)
    return len((made.with_images(*own) if images else made).targets.steps_BT)

for line in sys.stdin:
    kind = line.strip()
    if kind in ("opening", "reading"):
        dataset = Dataset(folder)
    if kind == "reading":
        for first, _ in rows:
            dataset.read(first, columns)
    with tempfile.TemporaryDirectory() as target:
        start = time.process_time()
        if kind.startswith("batches"):
            for indices in batches:
                read_batch(indices, kind == "batches")
        elif kind == "writing":
            with ShardWriter(Path(target) / "demos.arrow", info) as writer:
                for demo in demos:
                    writer.write(demo)
        else:
            for both in rows:
                dataset.read(both[kind == "reading"], columns)
        print(time.process_time() - start, flush=True)
"""
# Likewise, for training: a piece is 60 steps, of which the last 40 count.
TRAINING_WORKER = """
import json, sys, tempfile
from pathlib import Path
from openvima.training import TrainingConfig, train
settings = {"data": Path(sys.argv[1]), "schedule.steps": 60, "pretraining.steps": 0,
            "optimizer.learning_rate": 3e-4, "loader.batch_size": 64, "runtime.threads": 1}
for line in sys.stdin:
    with tempfile.TemporaryDirectory() as folder:
        train(TrainingConfig.of({**settings, "preset": line.strip(), "out": Path(folder) / "run"}))
        lines = Path(folder, "run", "timings_log.jsonl").read_text().splitlines()
    seconds = {each["step"]: each["cpu_seconds_since_start"] for each in map(json.loads, lines)}
    print((seconds[60] - seconds[20]) / 40, flush=True)
"""
DATA_KINDS = ("batches", "batches_without_images", "writing", "opening", "reading")


def environment(root: Path) -> dict[str, str]:
    """Return the variables with which Python imports the package of a checkout."""
    return os.environ | {"PYTHONPATH": str(root / "src"), "OMP_NUM_THREADS": "1"}


class Checkout:
    """A process that does pieces of work with the code of a checkout."""

    def __init__(self, root: Path, worker: str, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", worker, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment(root),
        )

    def seconds(self, piece: str) -> float:
        """Do a piece of work and return its CPU time."""
        assert self._process.stdin and self._process.stdout  # they are pipes
        print(piece, file=self._process.stdin, flush=True)
        return float(self._process.stdout.readline())


def ratio(pair: tuple[Checkout, Checkout], pieces: Sequence[str], repeats: int) -> float:
    """Return the time of the first checkout over that of the second."""
    best = [[math.inf, math.inf] for _ in pieces]
    for _ in range(NUM_WARM_UP):
        for checkout in pair:
            checkout.seconds(pieces[0])
    for _ in range(repeats):
        for piece, times in zip(pieces, best, strict=True):
            for side, checkout in enumerate(pair):
                times[side] = min(times[side], checkout.seconds(piece))
    return sum(base for base, _ in best) / sum(own for _, own in best)


def ratios(
    roots: Sequence[Path], worker: str, pieces: Mapping[str, Sequence[str]], repeats: int, folder: str = ""
) -> dict[str, float]:
    """Compare pieces of work of one kind, name by name."""
    first, second = (Checkout(root, worker, folder) for root in roots)
    found = {}
    for name, each in pieces.items():
        found[name] = round(ratio((first, second), each, repeats), 3)
        print(f"{name:28}{found[name]:.2f}", flush=True)
    return found


def command_ratio(roots: Sequence[Path], command: str, repeats: int) -> Ratios:
    """Compare a whole command, which gets a new folder `--out` each time."""
    best = [math.inf, math.inf]
    for _ in range(repeats):
        for side, root in enumerate(roots):
            with tempfile.TemporaryDirectory() as folder:
                words = [sys.executable, "-m", "openvima", *command.split(), "--out", f"{folder}/out"]
                before = os.times()
                subprocess.run(words, env=environment(root), check=True, stdout=subprocess.DEVNULL)
                after = os.times()
            seconds = after.children_user + after.children_system
            best[side] = min(best[side], seconds - before.children_user - before.children_system)
    print(f"{command}: {best[0]:.1f} s before, {best[1]:.1f} s now")
    return {"commands": {command: round(best[0] / best[1], 3)}}


def main() -> None:
    """Measure, print a table, and write JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--base", type=Path, required=True, help="work tree of the commit before")
    parser.add_argument("--tasks", default="all", help="names with commas between them, or 'all'")
    parser.add_argument("--seeds", type=int, default=6, help="episodes of a task")
    parser.add_argument("--repeats", type=int, default=5, help="of each piece of work")
    parser.add_argument("--data", type=Path, help="folder of demonstrations: compare data, not tasks")
    parser.add_argument("--presets", help="names with commas between them: compare training steps on --data")
    parser.add_argument("--command", help="a command of openvima, without --out, that is compared whole")
    parser.add_argument("--json", type=Path, help="file to write")
    given = parser.parse_args()
    tasks = list_tasks() if given.tasks == "all" else given.tasks.split(",")
    seeds = range(FIRST_SEED, FIRST_SEED + given.seeds)
    roots = given.base.resolve(), ROOT
    repeats, data = given.repeats, str(given.data and given.data.resolve())
    if given.command:
        found = command_ratio(roots, given.command, repeats)
    elif given.presets:
        pieces = {preset: [preset] for preset in given.presets.split(",")}
        found = {"training": ratios(roots, TRAINING_WORKER, pieces, repeats, data)}
    elif given.data:
        found = {"data": ratios(roots, DATA_WORKER, {kind: [kind] for kind in DATA_KINDS}, repeats, data)}
    else:
        found = {}
        for kind in ("sim", "decisions"):
            print(kind)
            pieces = {task: [f"{kind} {task} {seed}" for seed in seeds] for task in tasks}
            found[kind] = ratios(roots, WORKER, pieces, repeats)
    means = {
        kind: round(math.prod(r.values()) ** (1 / len(r)), 3) for kind, r in found.items() if kind != "data"
    }
    if means:
        print(f"{'geometric mean':28}", *(f"{kind} {mean:.2f}" for kind, mean in means.items()))
    if given.json:
        base = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=given.base, capture_output=True, text=True
        ).stdout.strip()
        result = {"base_commit": base, "ratios": found, "geometric_means": means, **circumstances()}
        atomic_write_file(given.json, json.dumps(result, indent=2) + "\n")


if __name__ == "__main__":
    main()
