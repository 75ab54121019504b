"""Every command on a data set of full size: time, rate, memory and bytes, and reading at random.

    python benchmarks/full_size.py FOLDER [--episodes N] [--workers W] [--steps S] [--out PATH]

Demonstrations of all training tasks, N of each, are generated into FOLDER, verified, extended by 1 %,
sampled, split, merged again, preprocessed and trained on. What a later command does not need is deleted: two
copies of the demonstrations are the most that lie on the disk at once. 50,000 of each task take 29 GB, their
object cache 40 GB. A command that was finished is not run again when the benchmark is.

Memory is that of a command and its children without mapped files. Rates come from the lines of progress that
a command prints. Reading is measured in turns on the 10 % sample and on all: opening, and whole episodes at
random. `--out` writes PATH.json, PATH.md and PATH.png. Exit status 1 if a command fails.
"""

import argparse
import json
import os
import re
import shlex
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from openvima.data import Dataset
from openvima.tasks import list_tasks, task_spec
from sim import circumstances

INTERVAL_S = 2.0  # between two samples of memory
NUM_READS = 300  # episodes at random, in each of the rounds
NUM_ROUNDS = 5
PROGRESS = re.compile(r": ([\d,]+) of ([\d,]+) \(")
MB = 2**20

Entry = dict[str, Any]


def memory_mb(pid: int) -> float:
    """Memory of a process and its descendants, without mapped files."""
    total = 0.0
    try:
        fields = dict(line.split(":", 1) for line in Path(f"/proc/{pid}/status").read_text().splitlines())
        total += sum(int(fields[name].split()[0]) for name in ("RssAnon", "RssShmem")) / 1024
        for task in Path(f"/proc/{pid}/task").iterdir():
            total += sum(memory_mb(int(child)) for child in (task / "children").read_text().split())
    except (OSError, KeyError):  # it ended in between
        pass
    return total


def size_mb(folder: Path) -> float:
    """Bytes of the files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / MB


def run(arguments: Sequence[str], folder: Path) -> Entry:
    """Run a command in a folder; return its time, memory, progress over time, and last lines."""
    started_s, lines, marks, memory = time.monotonic(), [], [], []
    process = subprocess.Popen(
        [sys.executable, "-m", *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )

    def listen() -> None:
        for line in process.stdout or ():
            lines.append(line.rstrip())
            if found := PROGRESS.search(line):
                done, whole = (int(number.replace(",", "")) for number in found.groups())
                marks.append((round(time.monotonic() - started_s, 1), done, whole))

    listener = threading.Thread(target=listen)
    listener.start()
    while process.poll() is None:
        memory.append((round(time.monotonic() - started_s, 1), round(memory_mb(process.pid), 1)))
        time.sleep(min(INTERVAL_S, 0.1 + memory[-1][0] / 20))
    listener.join()
    return {
        "command": shlex.join(arguments),
        "seconds": round(time.monotonic() - started_s, 1),
        "status": process.returncode,
        "progress": marks,
        "memory_mb": memory,
        "output": lines[-3:],
    }


def reading(sample: Path, whole: Path) -> Entry:
    """Open both data sets and read random episodes of them, in turns; return medians."""
    rng = np.random.default_rng(0)
    opened: dict[str, list[float]] = {"sample": [], "whole": []}
    read: dict[str, list[float]] = {"sample": [], "whole": []}
    counts = {}
    for _ in range(NUM_ROUNDS):
        for name, folder in (("sample", sample), ("whole", whole)):
            start_s = time.perf_counter()
            dataset = Dataset(folder)
            opened[name].append(time.perf_counter() - start_s)
            counts[name] = len(dataset)
            start_s = time.perf_counter()
            for index in rng.integers(len(dataset), size=NUM_READS).tolist():
                dataset[index]
            read[name].append(1000 * (time.perf_counter() - start_s) / NUM_READS)
    return {
        name: {
            "episodes": counts[name],
            "open_s": round(statistics.median(opened[name]), 3),
            "read_ms": round(statistics.median(read[name]), 2),
        }
        for name in counts
    }


def rates(entry: Entry) -> list[tuple[float, float]]:
    """Return the middle of each tenth of a command's work, in seconds, and its rate in `count` per second."""
    longest = max((whole for *_, whole in entry["progress"]), default=0)  # `verify` has a second count
    marks = [(at_s, done) for at_s, done, whole in entry["progress"] if whole == longest]
    if len(marks) < 3 or marks[-1][1] == marks[0][1]:  # two lines give no course
        return []
    times, done = np.array(marks, float).T
    done *= entry["count"] / marks[-1][1]  # commands count episodes, shards or steps
    bounds = np.linspace(done[0], done[-1], 11)
    at_s = np.interp(bounds, done, times)
    return [
        (float(start_s + end_s) / 2, float(step / (end_s - start_s)))
        for start_s, end_s, step in zip(at_s, at_s[1:], np.diff(bounds), strict=False)
        if end_s > start_s
    ]


def measure(options: argparse.Namespace) -> Entry:
    """Run all commands that have no record in the folder yet."""
    folder, episodes, workers = options.folder, options.episodes, ["--workers", str(options.workers)]
    folder.mkdir(parents=True, exist_ok=True)
    tasks = sum("train" in task_spec(task).levels for task in list_tasks())
    more, record = episodes + max(episodes // 100, 1), folder / "record.json"
    entries: Entry = json.loads(record.read_text(encoding="utf-8")) if record.exists() else {}

    def step(name: str, work: Callable[[], Entry], *, gone: Sequence[str] = ()) -> None:
        if name not in entries:
            print(name, flush=True)
            entry = work()
            if entry.get("status", 0):
                raise SystemExit("\n".join(entry["output"]))
            entries[name] = entry
            record.write_text(json.dumps(entries), encoding="utf-8")
        for each in gone:
            shutil.rmtree(folder / each, ignore_errors=True)

    def command(*arguments: str, out: str = "", count: int = more) -> Callable[[], Entry]:
        def work() -> Entry:
            entry = run(["openvima", *arguments, *workers], folder)
            entry["count"] = count * tasks
            return entry | ({"mb": round(size_mb(folder / out), 1)} if out else {})

        return work

    def generate(number: int, new: int) -> Callable[[], Entry]:
        arguments = ["generate", "--tasks", "all", "--episodes", str(number), "--out", "demos"]
        return command(*arguments, out="demos", count=new)

    train = ["train", "--data", "merged", "--preset", "nano", "--pretraining.steps", "0"]
    train += ["--schedule.steps", str(options.steps), "--out", "run"]
    step("generate", generate(episodes, episodes))
    step("verify", command("data", "verify", "demos", count=episodes))
    step("extend", generate(more, more - episodes))
    step("sample", command("data", "sample", "demos", "sample", "--fraction", "0.1", out="sample"))
    step("read", lambda: reading(folder / "sample", folder / "demos"), gone=["sample"])
    parts = "training=0.9,validation=0.1"
    step("split", command("data", "split", "demos", "parts", "--splits", parts, out="parts"), gone=["demos"])
    sources = ["parts/training", "parts/validation"]
    step("merge", command("data", "merge", *sources, "merged", out="merged"), gone=["parts"])
    step("preprocess", command("data", "preprocess", "merged", out="merged/object_cache"))
    step("train", lambda: run(["openvima", *train], folder) | {"count": options.steps})
    return entries


def draw(entries: Entry, path: Path) -> None:
    """Draw rates and memory of the commands over their time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, entry in entries.items():
        if name == "read":
            continue
        found = rates(entry)
        left.plot([at_s / 60 for at_s, _ in found], [rate for _, rate in found], label=name, marker=".")
        times, memory = zip(*entry["memory_mb"], strict=True)
        right.plot([at_s / 60 for at_s in times], [value / 1024 for value in memory], label=name)
    left.set_yscale("log")
    left.set_ylabel("episodes (train: steps) per second, by tenth of the work")
    right.set_ylabel("memory of the command, GB")
    right.set_ylim(bottom=0)
    right.legend(fontsize="small")
    for axes in (left, right):
        axes.set_xlabel("minutes")
    figure.savefig(path, dpi=120, metadata={"Software": None})


def report(result: Entry, figure: str) -> str:
    """Return the results as Markdown."""
    lines = [
        f"# Commands on {result['episodes']:,} demonstrations",
        "",
        f"`{result['command']}`, commit `{result['commit']}`, {result['machine']}, "
        f"Python {result['python']}.",
        "",
        "| command | minutes | per second | first tenth | last tenth | memory, MB | GB written |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, entry in result["entries"].items():
        if name == "read":
            continue
        found = [rate for _, rate in rates(entry)]
        cells = [f"{value:,.1f}" for value in (found[0], found[-1])] if found else ["", ""]
        written = f"{entry['mb'] / 1024:.1f}" if "mb" in entry else ""
        rate, most = entry["count"] / entry["seconds"], max(value for _, value in entry["memory_mb"])
        lines.append(
            f"| `{entry['command']}` | {entry['seconds'] / 60:.1f} | {rate:,.1f} | {' | '.join(cells)} "
            f"| {most:,.0f} | {written} |"
        )
    read = result["entries"]["read"]
    lines += [
        "",
        "Episodes per second, for `train` steps. Rates of the first and last tenth of the work come from the "
        "lines of progress. Memory is the most that a command and its children had together, without mapped "
        "files.",
        "",
        "| reading | episodes | opening, s | a whole episode at random, ms |",
        "|---|---:|---:|---:|",
        *(
            f"| {name} | {entry['episodes']:,} | {entry['open_s']} | {entry['read_ms']} |"
            for name, entry in read.items()
        ),
        "",
        f"![Rates and memory over time]({figure})",
    ]
    return "\n".join(lines) + "\n"


def performance(result: Entry) -> list[Entry]:
    """Return the figures that belong in docs/performance.md."""
    entries = result["entries"]
    whole, size = entries["read"]["whole"], f"{result['episodes']:,} demonstrations"
    rates = [
        (name, round(entries[name]["count"] / entries[name]["seconds"])) for name in ("generate", "verify")
    ]
    figures = [
        *((f"full size, {name} over the whole command", rate, "episodes/s") for name, rate in rates),
        ("full size, memory of generate", max(mb for _, mb in entries["generate"]["memory_mb"]), "MB"),
        (f"opening a data set of {size}", whole["open_s"], "s"),
        (f"a whole episode at random of {size}", whole["read_ms"], "ms"),
    ]
    source = {"command": result["command"], "commit": result["commit"]}
    return [{"what": what, "value": value, "unit": unit, **source} for what, value, unit in figures]


def main() -> None:
    """Run, print the report, and write it, its data and a figure if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--episodes", type=int, default=50_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--out", type=Path, help="write PATH.json, PATH.md and PATH.png")
    options = parser.parse_args()
    about = circumstances()
    entries = measure(options)
    command = f"python benchmarks/full_size.py FOLDER --episodes {options.episodes}"
    result = {
        "command": command,
        **about,
        "episodes": entries["read"]["whole"]["episodes"],
        "entries": entries,
    }
    result["performance"] = performance(result)
    name = options.out.name if options.out else "full_size"
    text = report(result, f"{name}.png")
    print(text)
    if options.out:
        file = options.out.with_name(f"{name}.json")
        file.write_text(json.dumps(result, ensure_ascii=False) + "\n", encoding="utf-8")
        options.out.with_name(f"{name}.md").write_text(text, encoding="utf-8")
        draw(entries, options.out.with_name(f"{name}.png"))


if __name__ == "__main__":
    main()
