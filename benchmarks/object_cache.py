"""How fast the object cache is read, on one core: single episodes, and padded batches for a network.

    python benchmarks/object_cache.py [--data DIR] [--episodes N] [--batch B] [--rounds N] [--json FILE]

Training steps a second of CPU time, best of alternating rounds; files lie in the system's cache. Checksums of
all that is read are compared, at every read.
`episodes`: one after the other, in random order.
`batches`: padded tensors of prompts, observations, targets and the images in use, as `openvima train` makes
them without augmentation; batches are drawn as in training, of episodes of similar length.
`batches_without_images`: the same where the crop encoder is frozen and its features are kept.
`memory_map`: for comparison, nothing but a copy of the images in use out of the mapped files, no checksums.
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import itertools

import numpy as np
import pyarrow as pa
import torch

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.object_cache import ObjectCache, open_object_cache
from openvima.data.preprocessed import number_images
from openvima.policies.processor import Processor
from openvima.tasks import list_tasks, task_spec
from openvima.training.batches import BatchOrder
from sim import circumstances

Numbers = dict[str, Any]


def ways_of(cache: ObjectCache, batch: int) -> dict[str, Callable[[], object]]:
    """Return functions that read every episode once."""
    processor = Processor("objects")
    shuffled = np.random.default_rng(0).permutation(len(cache)).tolist()
    order = BatchOrder(len(cache), batch_size=batch, lengths=cache.lengths())
    batches = [order.rows(number) for number in range(order.batches_per_epoch)]

    def read_batch(rows: np.ndarray, *, images: bool) -> int:
        episodes = number_images([cache[row] for row in rows.tolist()])
        made = processor.collate(episodes)
        if images:
            made = made.with_images([episode.images for episode in episodes])
        return len(made.targets.steps_BT)

    used = []  # images in use come first in an episode
    for rows in batches:
        for episode in map(cache.__getitem__, rows.tolist()):
            tables = (episode.prompt.objects, episode.objects)
            used.append(episode.images[: max(int(table.crop_index.max(initial=0)) for table in tables)])
    ends = np.cumsum([0, *(len(rows) for rows in batches)]).tolist()

    return {
        "episodes": lambda: [len(cache[number].images) for number in shuffled],
        "batches": lambda: [read_batch(rows, images=True) for rows in batches],
        "batches_without_images": lambda: [read_batch(rows, images=False) for rows in batches],
        "memory_map": lambda: [
            len(np.concatenate(used[start:end])) for start, end in itertools.pairwise(ends)
        ],
    }


def measure(dataset: Dataset, *, batch: int, rounds: int) -> Numbers:
    """Make the object cache of a data set, and read it in every way."""
    start = time.process_time()
    cache = open_object_cache(dataset)
    making = time.process_time() - start
    ways = ways_of(cache, batch)
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(rounds + 1):
        for name, work in ways.items():
            start = time.process_time()
            work()
            times[name].append(time.process_time() - start)
    num_steps, count = int(cache.lengths()[:, 0].sum()), len(cache)
    return {
        "episodes": count,
        "steps_per_episode": round(num_steps / count, 3),
        "images_per_episode": round(float(cache.image_counts().mean()), 1),
        "bytes": round(sum(path.stat().st_size for path in cache.folder.iterdir()) / count),
        "making_ms": round(1000 * making / count, 3),
        "batch": batch,
        "training_steps_per_s": {name: round(num_steps / min(each[1:])) for name, each in times.items()},
    }


def main() -> None:
    """Measure, print, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument(
        "--data", type=Path, help="folder of demonstrations; default: generated for all tasks"
    )
    parser.add_argument("--episodes", type=int, default=60, help="episodes of a task, where generated")
    parser.add_argument("--batch", type=int, default=128, help="episodes of a batch")
    parser.add_argument("--rounds", type=int, default=15, help="alternating rounds")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    pa.set_cpu_count(1)
    torch.set_num_threads(1)
    where = circumstances() | {"rounds": options.rounds}
    print(", ".join(f"{name}: {value}" for name, value in where.items()))
    with tempfile.TemporaryDirectory() as name:
        tasks = tuple(task for task in list_tasks() if "train" in task_spec(task).levels)
        folder = options.data or generate(
            GenerateConfig(out=Path(name) / "demos", tasks=tasks, episodes=options.episodes)
        )
        numbers = measure(Dataset(folder), batch=options.batch, rounds=options.rounds)
    for key, value in numbers.items():
        print(f"{key}: {value}")
    if options.json:
        options.json.write_text(json.dumps({**numbers, **where}, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
