"""Several machines at work: does a lost one, or a second job array, change what is written?

    python benchmarks/cluster.py [--episodes N] [--only generate,evaluate,study,arrays] [--json FILE]

Starts a Ray cluster of three simulated machines with one CPU each. `openvima generate`, `evaluate` and
`study` run on it as on a real one, through `--engine ray --address`, and one machine is killed once a third
of the work is on the disk. Each result is compared with that of one process, byte by byte, and each finished
file that was there when the machine died must be the same file afterwards: its work was not done again.

`arrays` runs two job arrays at once on one folder, whose ranges of shards overlap, by `--shard-range`; jobs
that another one is in the way of are refused, and submitted again until all succeed.

Exit status 1 if anything differs.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from openvima.studies import Demonstrations, EvaluationSettings, Run, Study
from sim import circumstances

POLL_S = 0.05
LIMIT_S = 1800.0
TASKS = "rotate,visual_manipulation,rearrange,same_shape"
NUM_JOBS = 3  # of each array


def study(_inputs: object) -> Study:
    """Return a study of a few steps, for `openvima study cluster.py:study`."""
    return Study(
        "cluster",
        "Does a lost machine change it?",
        "fraction",
        (Run("all"), Run("half", data_fraction=0.5)),
        EvaluationSettings(("rotate", "visual_manipulation"), ("L1",), 8),
        Demonstrations(("rotate", "visual_manipulation"), 40),
        {"preset": "nano", "schedule.steps": 30, "schedule.checkpoint_every": 5, "pretraining.steps": 10},
    )


@dataclass(frozen=True, slots=True)
class Work:
    """A command whose results must not depend on who runs it.

    Args:
        arguments: Of `openvima`, without folder and workers.
        files: Patterns of files that are never written again.
        compared: Patterns of files whose bytes are the result.
    """

    arguments: tuple[str, ...]
    files: tuple[str, ...]
    compared: tuple[str, ...]

    def command(self, out: Path, *options: str) -> list[str]:
        """Return the command line."""
        return [sys.executable, "-m", "openvima", *self.arguments, "--out", str(out), *options]

    def finished(self, out: Path) -> dict[str, tuple[int, int]]:
        """Return inode and time of each file that is whole."""
        found = {}
        for pattern in self.files:
            for path in out.glob(pattern):
                try:
                    status = path.stat()
                except FileNotFoundError:
                    continue
                found[str(path.relative_to(out))] = (status.st_ino, status.st_mtime_ns)
        return found

    def num_shards(self, out: Path) -> int:
        """Return into how many files the command divides its work; `study` does not say."""
        command = self.command(out, "--list-shards")
        listed = subprocess.run(command, capture_output=True, text=True, check=True)
        return len(listed.stdout.splitlines())

    def contents(self, out: Path) -> dict[str, bytes]:
        """Return the bytes of the result by file."""
        paths = (path for pattern in self.compared for path in out.glob(pattern))
        return {str(path.relative_to(out)): path.read_bytes() for path in paths}


@dataclass(slots=True)
class Finding:
    """What was seen."""

    seconds: float = 0.0
    files: int = 0  # in the end, or when last seen
    at_the_loss: int = 0
    repeated: list[str] = field(default_factory=list)
    refused: int = 0
    same_bytes: bool = False

    @property
    def good(self) -> bool:
        """Whether all is as it should be."""
        return self.same_bytes and not self.repeated


def works(episodes: int) -> dict[str, Work]:
    """Return the commands by name."""
    return {
        "generate": Work(
            tuple(f"generate --tasks {TASKS} --episodes {episodes} --shard-size 10".split()),
            ("*.arrow",),
            ("*",),
        ),
        "evaluate": Work(
            tuple(
                f"evaluate --policy openvima-small --tasks {TASKS} --levels L1,L3 --episodes {episodes} "
                "--batch 8 --seed 70000 --videos 0".split()
            ),
            ("parts/*.json",),
            ("results.json",),
        ),
        "study": Work(
            ("study", f"{Path(__file__).resolve()}:study", "--seeds", "2"),
            ("**/results.json", "**/checkpoints/*[0-9]/model.safetensors"),
            ("**/results.json", "**/model.safetensors"),  # study.json also has times
        ),
    }


def on_a_cluster(work: Work, out: Path, total: int) -> Finding:
    """Run a command on three machines, of which one dies when a third of its files is there."""
    from ray.cluster_utils import Cluster

    options = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 100 * 2**20}
    cluster = Cluster(initialize_head=True, head_node_args=options)
    seen = Finding()
    try:
        lost, _ = (cluster.add_node(**options) for _ in range(2))
        cluster.wait_for_nodes()
        begun = time.monotonic()
        process = subprocess.Popen(work.command(out, "--engine", "ray", "--address", str(cluster.address)))
        latest: dict[str, tuple[int, int]] = {}
        at_loss: dict[str, tuple[int, int]] | None = None
        while process.poll() is None:
            latest |= work.finished(out)
            if at_loss is None and len(latest) >= max(1, total // 3):
                at_loss = dict(latest)
                cluster.remove_node(lost, allow_graceful=False)
            if time.monotonic() - begun > LIMIT_S:
                process.kill()
            time.sleep(POLL_S)
        latest |= work.finished(out)
        seen.seconds, seen.files = time.monotonic() - begun, len(latest)
        if process.returncode or at_loss is None:
            seen.repeated = [f"exit status {process.returncode}; {seen.files} files when it ended"]
        else:
            seen.at_the_loss = len(at_loss)
            seen.repeated = sorted(name for name, mark in at_loss.items() if latest[name] != mark)
    finally:
        cluster.shutdown()
    return seen


def in_two_arrays(work: Work, out: Path) -> Finding:
    """Run two job arrays at once whose ranges overlap, and submit what was refused again."""
    count = work.num_shards(out)
    step = -(-count // NUM_JOBS)
    first = [(a, min(a + step, count)) for a in range(0, count, step)]
    second = [(max(0, a - step // 2), min(b - step // 2, count)) for a, b in first] + [(count - 1, count)]
    waiting, seen, begun = [*first, *second], Finding(), time.monotonic()
    while waiting:
        running = [
            (job, subprocess.Popen(work.command(out, "--shard-range", f"{job[0]}:{job[1]}")))
            for job in waiting
        ]
        waiting = [job for job, process in running if process.wait(LIMIT_S)]
        seen.refused += len(waiting)
        if len(waiting) == len(running):
            seen.repeated = [f"no job of {waiting} succeeded"]
            break
    seen.seconds, seen.files = time.monotonic() - begun, count
    return seen


def compared(work: Work, alone: Path, out: Path, seen: Finding) -> Finding:
    """Compare a result with that of one process."""
    expected = work.contents(alone)
    seen.same_bytes = bool(expected) and work.contents(out) == expected
    return seen


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--episodes", type=int, default=200, help="of each task (and level)")
    parser.add_argument("--only", default="generate,evaluate,study,arrays")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args(argv)
    chosen, made = args.only.split(","), works(args.episodes)
    findings: dict[str, Finding] = {}
    with tempfile.TemporaryDirectory(prefix="cluster") as name:
        folder = Path(name)
        for verb, work in made.items():
            arrays = "arrays" in chosen and verb != "study"
            if verb not in chosen and not arrays:
                continue
            alone = folder / f"{verb}_alone"
            subprocess.run(work.command(alone, "--workers", "1"), check=True)
            if verb in chosen:
                out = folder / verb
                total = len(work.finished(alone)) if verb == "study" else work.num_shards(out)
                findings[verb] = compared(work, alone, out, on_a_cluster(work, out, total))
            if arrays:
                out = folder / f"{verb}_arrays"
                findings[f"{verb}, two arrays"] = compared(work, alone, out, in_two_arrays(work, out))
    for verb, seen in findings.items():
        print(f"{verb:<22}{seen}")
    if args.json:
        content = {"command": sys.argv, **circumstances()}
        content["findings"] = {verb: asdict(seen) for verb, seen in findings.items()}
        args.json.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return 0 if all(seen.good for seen in findings.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
