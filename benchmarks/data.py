"""What storing demonstrations costs: time to write, bytes, and how fast they are read again, on one core.

    python benchmarks/data.py [--quick] [--tasks a,b|all] [--episodes N] [--json FILE]

Generation: each seed is played twice, once for itself and once to be written, in turns; the share is the time
of the bare simulator over that of simulator, encoding, hashing, compression, file, index and manifest.
Sizes: the same episodes in every format. "png" and "jpeg" are the layout of the published data set, the
frames of the cameras as files and all else in pickles, losslessly and as it was published; "png_all" has
segmentation and prompt images as files too.
Reading: a training step is what a policy sees before an action, colours and segmentation of both views; once
an episode its prompt images belong to it. Files lie in the system's cache.
All times are CPU time, so that other work on the machine counts little; only closing a file and writing
index and manifest, which wait for the disk once a shard, are given as they pass.
Memory: what the process holds besides mapped files, while it reads the same episodes over and over.
"""

import argparse
import itertools
import json
import os
import pickle
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pyarrow as pa
from PIL import Image

from openvima.data import Dataset, Demonstration, ShardWriter, rollout_oracle
from openvima.data.encoding import ShardInfo
from openvima.data.manifest import finish_folder
from openvima.data.records import package_versions
from openvima.data.schema import ARRAYS, VIEWS
from openvima.env import TabletopEnv
from openvima.errors import OracleError, SamplingError
from openvima.render import channels_last
from openvima.tasks import list_tasks
from sim import circumstances

FIRST_SEED = 3_000_000
NUM_WARM_UP = 5  # episodes of a task
NUM_PUBLISHED = 650_000  # episodes of the published data set
NUM_CORES = 16
# What a training step takes from an episode, and what tells it what the images show.
TRAINING_COLUMNS = [*(name for name in ARRAYS if name != "poses"), "prompt", "prompt_images", "end_effector"]
FORMATS = ("lz4", "zstd", "no_images", "png", "png_all", "jpeg")

Numbers = dict[str, Any]


def play(env: TabletopEnv, seed: int) -> Demonstration | None:
    """Let the oracle play a seed; None if it does not solve it."""
    try:
        demo = rollout_oracle(env, seed)
    except (SamplingError, OracleError):
        return None
    return demo if demo.outcome.success else None


def info_of(env: TabletopEnv, codec: str = "lz4", *, images: bool = True) -> ShardInfo:
    """Describe a shard of an environment's episodes."""
    return ShardInfo(
        task=env.task,
        level=env.level,
        domain=env.domain,
        number=0,
        shard_size=0,
        first_seed=FIRST_SEED,
        assets=env.assets.name,
        versions=package_versions(),
        compression=codec,
        images=images,
    )


def timed(work: Callable[..., Any], *arguments: object) -> tuple[float, Any]:
    """Return the seconds of CPU time that a call takes, in all threads, and its result."""
    start = time.process_time()
    result = work(*arguments)
    return time.process_time() - start, result


def measure_generation(env: TabletopEnv, num_episodes: int, folder: Path) -> Numbers:
    """Play seeds twice, with and without writing; the episodes are then in `folder`."""
    folder.mkdir()
    warm_up(env, folder)
    path = folder / f"{env.task}-{env.level}-00000.arrow"
    bare, stored, lengths = [], [], []
    with ShardWriter(path, info_of(env)) as writer:

        def play_and_write(env: TabletopEnv, seed: int) -> Demonstration | None:
            if demo := play(env, seed):
                writer.write(demo)
            return demo

        for seed in itertools.count(FIRST_SEED):
            ways = [(bare, play), (stored, play_and_write)]
            for times, way in ways if seed % 2 else ways[::-1]:  # neither always comes second
                seconds, demo = timed(way, env, seed)
                times.append(seconds)
            lengths += [demo.num_steps] if demo else []
            if len(lengths) == num_episodes:
                break
        start = time.perf_counter()
    closing = time.perf_counter() - start
    start = time.perf_counter()
    finish(folder, [path])
    finishing = time.perf_counter() - start
    return {
        "episodes_per_s": round(num_episodes / sum(stored), 2),
        "bare_episodes_per_s": round(num_episodes / sum(bare), 2),
        "share_of_bare": round(sum(bare) / sum(stored), 3),
        "storing_ms": round(1000 * (sum(stored) - sum(bare)) / num_episodes, 3),
        "steps_per_episode": round(statistics.fmean(lengths), 3),
        "closing_a_shard_ms": round(1000 * closing, 1),
        "index_and_manifest_ms": round(1000 * finishing, 1),
    }


def warm_up(env: TabletopEnv, folder: Path) -> None:
    """Load the kernels, and fill the caches of shapes and textures."""
    path = folder / "warm_up.arrow"
    with ShardWriter(path, info_of(env)) as writer:
        for demo in filter(None, (play(env, seed) for seed in range(NUM_WARM_UP))):
            writer.write(demo)
    path.unlink()


def finish(folder: Path, shards: Sequence[Path]) -> None:
    """Write index and manifest of a folder."""
    finish_folder(folder, shards, command="benchmark", config={}, versions=package_versions())


def measure_formats(env: TabletopEnv, demos: Sequence[Demonstration], folder: Path) -> Numbers:
    """Write and read episodes in each format; return bytes and milliseconds an episode."""
    results = {}
    for name in FORMATS:
        target = folder / name
        target.mkdir(parents=True)
        writing, reading = measure_format(env, demos, target, name)
        num_bytes = sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
        results[name] = {
            "bytes": round(num_bytes / len(demos)),
            "write_ms": round(1000 * writing / len(demos), 3),
            "read_ms": round(1000 * reading / len(demos), 3),
        }
    return results


def measure_format(
    env: TabletopEnv, demos: Sequence[Demonstration], folder: Path, name: str
) -> tuple[float, float]:
    """Write and read episodes in one format; return seconds."""
    if name in ("png", "png_all", "jpeg"):
        writing, _ = timed(lambda: [write_files(folder / f"{n:06d}", d, name) for n, d in enumerate(demos)])
        return writing, timed_again(lambda: [len(read_files(folder / f"{n:06d}")) for n in range(len(demos))])
    info = info_of(env, "zstd" if name == "zstd" else "lz4", images=name != "no_images")
    path = folder / f"{env.task}-{env.level}-00000.arrow"

    def write() -> None:
        with ShardWriter(path, info) as writer:
            for demo in demos:
                writer.write(demo)

    writing, _ = timed(write)
    finish(folder, [path])
    dataset = Dataset(folder)
    return writing, timed_again(
        lambda: [dataset.read(n, TRAINING_COLUMNS)["prompt"] for n in range(len(dataset))]
    )


def timed_again(work: Callable[[], Any]) -> float:
    """Return the seconds of the second of two calls; at first, memory is fetched and caches fill.

    The work must not keep what it reads: fetching memory for it takes longer than decoding.
    """
    work()
    return timed(work)[0]


def write_files(folder: Path, demo: Demonstration, layout: str) -> None:
    """Write an episode as a folder of images and pickles, the layout of the published data set."""
    kind = "jpg" if layout == "jpeg" else "png"
    shown = demo.prompt.images
    for view in VIEWS:
        (folder / f"rgb_{view}").mkdir(parents=True)
        for step, image in enumerate(demo.rgb[view]):
            Image.fromarray(channels_last(image)).save(folder / f"rgb_{view}" / f"{step}.{kind}")
        if layout == "png_all":
            for step, ids in enumerate(demo.segm[view]):
                Image.fromarray(ids).save(folder / f"segm_{view}_{step}.png")
            for name, image in shown.items():
                Image.fromarray(channels_last(image.rgb[view])).save(folder / f"{name}_rgb_{view}.png")
                Image.fromarray(image.segm[view]).save(folder / f"{name}_segm_{view}.png")
    is_raw = layout != "png_all"
    actions = [action.to_arrays() for action in demo.actions]
    pickles: dict[str, object] = {
        "obs": {"segm": demo.segm if is_raw else {}, "ee": demo.observation(0)["ee"]},
        "action": {key: np.stack([action[key] for action in actions]) for key in actions[0]},
        "trajectory": {
            "prompt": demo.prompt.text,
            "prompt_assets": {n: {"rgb": i.rgb, "segm": i.segm} for n, i in shown.items()} if is_raw else {},
            "objects": [(o.object_id, o.object, o.texture) for o in demo.objects],
            "seed": demo.seed,
            "steps": demo.num_steps,
        },
    }
    for name, content in pickles.items():
        (folder / f"{name}.pkl").write_bytes(pickle.dumps(content, protocol=4))


def read_files(folder: Path) -> list[object]:
    """Read all that `write_files` wrote."""
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    return [
        pickle.loads(path.read_bytes()) if path.suffix == ".pkl" else np.asarray(Image.open(path))
        for path in paths
    ]


def measure_reading(dataset: Dataset, num_rounds: int) -> Numbers:
    """Read a task's episodes in several ways; return training steps a second, the median of the rounds."""
    rng = np.random.default_rng(0)
    shuffled = rng.permutation(len(dataset)).tolist()
    lengths = dataset.index.column("steps").to_numpy()
    ways: dict[str, tuple[Callable[[], object], int]] = {
        "columns": (
            lambda: [dataset.read(n, TRAINING_COLUMNS)["prompt"] for n in range(len(dataset))],
            lengths.sum(),
        ),
        "columns_shuffled": (
            lambda: [dataset.read(n, TRAINING_COLUMNS)["prompt"] for n in shuffled],
            lengths.sum(),
        ),
        "demonstrations": (lambda: [dataset[n].num_steps for n in range(len(dataset))], lengths.sum()),
    }
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(num_rounds + 1):
        for name, (work, _) in ways.items():
            times[name].append(timed(work)[0])
    return {name: round(count / statistics.median(times[name][1:])) for name, (_, count) in ways.items()}


def measure_memory(dataset: Dataset, num_reads: int) -> Numbers:
    """Read episodes over and over; return megabytes held, and by how many they grow in 1,000 episodes."""
    held = []
    for number in range(num_reads):
        dataset.read(number % len(dataset), TRAINING_COLUMNS)
        if number >= num_reads // 4 and number % 20 == 0:  # at first, buffers and caches fill
            held.append((number, anonymous_megabytes()))
    numbers, megabytes = np.array(held).T
    slope = float(np.polyfit(numbers, megabytes, 1)[0])
    return {
        "episodes_read": num_reads,
        "held_mb": round(float(megabytes[-1]), 1),
        "growth_mb_per_1000_episodes": round(1000 * slope, 3),
    }


def anonymous_megabytes() -> float:
    """Return what the process holds in memory besides mapped files; 0 where the system does not tell."""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.is_file() else []
    return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("RssAnon")), 0.0)


def measure_all(tasks: Sequence[str], num_episodes: int, num_rounds: int, folder: Path) -> Numbers:
    """Measure task by task; return a dictionary of results by task."""
    results: Numbers = {}
    for task in tasks:
        env = TabletopEnv(task, domain="train")
        generation = measure_generation(env, num_episodes, folder / task)
        dataset = Dataset(folder / task)
        demos = [dataset[n] for n in range(max(4, num_episodes // 4))]
        results[task] = {
            "generation": generation,
            "formats": measure_formats(env, demos, folder / "formats" / task),
            "training_steps_per_s": measure_reading(dataset, num_rounds),
        }
        print(line(task, results[task]), flush=True)
    return results


def line(task: str, entry: Numbers) -> str:
    """Return one task's results as a line of text."""
    made, read = entry["generation"], entry["training_steps_per_s"]
    sizes = " ".join(f"{entry['formats'][name]['bytes'] / 1000:>9.1f}" for name in FORMATS)
    return (
        f"{task:<28}{made['bare_episodes_per_s']:>8.1f}{made['share_of_bare']:>7.1%} {sizes} "
        f"{read['columns']:>9,}{read['columns_shuffled']:>9,}{read['demonstrations']:>9,}"
    )


HEAD = (
    f"{'task':<28}{'bare/s':>8}{'share':>7} " + " ".join(f"{name:>9}" for name in FORMATS) + " "
    f"{'steps/s':>9}{'shuffled':>9}{'demos':>9}   (sizes in kB an episode)"
)


def summary(results: Numbers) -> Numbers:
    """Return means over the tasks, and what follows for a data set of the published size."""
    entries = list(results.values())
    making = [1 / entry["generation"]["episodes_per_s"] for entry in entries]
    means: Numbers = {
        "share_of_bare_geomean": round(
            statistics.geometric_mean(e["generation"]["share_of_bare"] for e in entries), 3
        ),
        "tasks_below_85_percent": [t for t, e in results.items() if e["generation"]["share_of_bare"] < 0.85],
        "formats": {
            name: {
                key: round(statistics.fmean(entry["formats"][name][key] for entry in entries), 3)
                for key in ("bytes", "write_ms", "read_ms")
            }
            for name in FORMATS
        },
        "training_steps_per_s": {
            way: {
                "geomean": round(
                    statistics.geometric_mean(entry["training_steps_per_s"][way] for entry in entries)
                ),
                "of_equal_episodes": round(mean_rate(entries, way)),
            }
            for way in entries[0]["training_steps_per_s"]
        },
    }
    size = means["formats"]["lz4"]["bytes"]
    return means | {
        "extrapolated_not_measured": {
            "episodes": NUM_PUBLISHED,
            "cores": NUM_CORES,
            "hours": round(NUM_PUBLISHED * statistics.fmean(making) / NUM_CORES / 3600, 2),
            "gigabytes_lz4": round(NUM_PUBLISHED * size / 1e9, 1),
            "gigabytes_zstd": round(NUM_PUBLISHED * means["formats"]["zstd"]["bytes"] / 1e9, 1),
        }
    }


def mean_rate(entries: Sequence[Numbers], way: str) -> float:
    """Return steps a second where every task has equally many episodes."""
    lengths = [e["generation"]["steps_per_episode"] for e in entries]
    times = [n / e["training_steps_per_s"][way] for n, e in zip(lengths, entries, strict=True)]
    return sum(lengths) / sum(times)


def main() -> None:
    """Measure, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--quick", action="store_true", help="few episodes, to try it out")
    parser.add_argument("--tasks", default="all", help="names with commas between them, or 'all'")
    parser.add_argument("--episodes", type=int, default=100, help="episodes of a task")
    parser.add_argument("--rounds", type=int, default=5, help="alternating rounds of reading")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    pa.set_cpu_count(1)
    tasks = list(list_tasks()) if options.tasks == "all" else options.tasks.split(",")
    num_episodes = 12 if options.quick else options.episodes
    where = circumstances() | {"episodes": num_episodes, "rounds": options.rounds}
    print(", ".join(f"{name}: {value}" for name, value in where.items()))
    print(HEAD)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        results = measure_all(tasks, num_episodes, options.rounds, folder)
        means = summary(results)
        means["memory"] = measure_memory(Dataset(folder / tasks[0]), 400 if options.quick else 4000)
    for key, value in means.items():
        print(f"{key}: {value}")
    if options.json:
        content = {**means, "tasks": results, **where}
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
