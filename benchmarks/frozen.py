"""What a redesign must not move: recorded once, compared after every step.

    python benchmarks/frozen.py --check                  all parts, about ten minutes on one core
    python benchmarks/frozen.py --check --part batches   one part, or several with commas between
    python benchmarks/frozen.py --part names             record a part anew

names      Public names: `__all__` of the package and of its packages. Names may be added.
episodes   Sampled episodes, five seeds of every published task and level.
shards     Demonstrations of all tasks: the bytes of every shard, and the hash of every episode.
batches    Ten batches of a training, tensor by tensor, of each recipe in `RECIPES`, with true crops.
losses     All metrics of 20 steps of pretraining, where the recipe has it, and of 50 steps of training.
outcomes   What openvima-small reaches in every episode; `--episodes 1` takes a minute instead of many.

The record is `benchmarks/frozen.json`. Everything but losses is compared exactly; losses with the relative
tolerance `TOLERANCE`, since machines add in other orders. Of all this only `watched_batches` knows more than
public names and commands: where a redesign moves what it hooks into, adapt it there.
"""

import argparse
import contextlib
import dataclasses
import functools
import hashlib
import importlib
import io
import json
import os
import pkgutil
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

import openvima
from openvima.catalog.partitions import PUBLISHED_LEVELS, PUBLISHED_TASKS
from openvima.cli.main import main as openvima_command
from openvima.tasks import sample_episode, task_spec

RECORD = Path(__file__).with_suffix(".json")
TOLERANCE = 1e-4
RECIPES = {"nano": "nano", "small": "small", "vima-nano": "papers", "midas-nano": "papers-midas"}  # by preset
# What makes a training short; the recipe sets everything else.
_SHORT = ("--loader.batch-size=16", "--runtime.processes=1", "--runtime.threads=1", "--runtime.device=cpu")
_FLOAT = re.compile(r"-?\d+\.\d+(?:e[+-]?\d+)?")


def names(_: argparse.Namespace) -> dict[str, list[str]]:
    """Return the public names by package."""
    packages = [each.name for each in pkgutil.walk_packages(openvima.__path__, "openvima.") if each.ispkg]
    recorded = json.loads(RECORD.read_text())["names"]  # some packages have become modules
    modules = map(importlib.import_module, dict.fromkeys(["openvima", *packages, *recorded]))
    return {each.__name__: sorted(each.__all__) for each in modules if hasattr(each, "__all__")}


def episodes(_: argparse.Namespace) -> dict[str, str]:
    """Return digests of the first episodes by task, numbers rounded so that they hold on every machine."""
    found = {}
    for task in sorted(PUBLISHED_TASKS):
        total = hashlib.sha256()
        for level in filter(PUBLISHED_LEVELS.__contains__, task_spec(task).levels):
            for seed in range(5):
                for domain in ("train", "eval") if level == "train" else ("eval",):
                    problem = sample_episode(task, level=level, seed=seed, domain=domain).problem
                    for _path, value in leaves(problem):
                        total.update(_FLOAT.sub(lambda m: f"{float(m[0]) + 0.0:.6f}", repr(value)).encode())
        found[task] = total.hexdigest()[:16]
    return found


def shards(_: argparse.Namespace) -> dict[str, str]:
    """Return digests of the files of a small data set."""
    return {
        path.name: _digest(path.read_bytes())
        for path in sorted(demonstrations().iterdir())
        if "log" not in path.name and path.is_file()
    }


def batches(_: argparse.Namespace) -> dict[str, dict[str, str]]:
    """Return the digest of each tensor over ten batches by preset; without pretraining, so with crops."""
    found = {}
    for preset in RECIPES:
        totals: dict[str, Any] = {}
        with watched_batches() as seen:
            train(
                preset,
                "--schedule.steps=10",
                "--pretraining.steps=0",
                "--pretraining.finetune-crop-encoder=True",
            )
            for batch in seen:
                for path, value in leaves(batch):
                    totals.setdefault(path, hashlib.sha256()).update(_bytes(value))
        found[preset] = {path: total.hexdigest()[:12] for path, total in sorted(totals.items())}
    return found


def losses(_: argparse.Namespace) -> dict[str, list[dict[str, float]]]:
    """Return the lines of `metrics.jsonl` by preset: means over up to 20 steps."""
    found = {}
    short = ("--pretraining.steps=20", "--pretraining.num-scenes=60", "--pretraining.batch-size=32")
    for preset in RECIPES:
        with tempfile.TemporaryDirectory() as folder:
            run = train(preset, "--schedule.steps=50", *short, out=Path(folder) / "run")
            lines = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
        found[preset] = [{k: v for k, v in json.loads(line).items() if k != "name"} for line in lines]
    return found


def outcomes(options: argparse.Namespace) -> dict[str, str]:
    """Return steps and success (+ or -) of every episode, by task and level."""
    with tempfile.TemporaryDirectory() as folder:
        given = f"--tasks=all --levels=L1,L2,L3,L4 --episodes={options.episodes} --workers=1 --no-report"
        run("evaluate", "--policy=openvima-small", f"--out={folder}/out", *given.split())
        rows = json.loads(Path(folder, "out", "results.json").read_text(encoding="utf-8"))["rows"]
    return {
        f"{row['task']} {row['level']}": " ".join(
            f"{each['steps']}{'+' if each['success'] else '-'}" for each in row["outcomes"]
        )
        for row in rows
    }


PARTS: dict[str, Callable[[argparse.Namespace], Any]] = {
    each.__name__: each for each in (names, episodes, shards, batches, losses, outcomes)
}


@contextlib.contextmanager
def watched_batches() -> Iterator[list[object]]:
    """Collect the batches that are trained on while the context lasts."""
    import torch

    from openvima.training import learner

    seen: list[object] = []
    forward = learner.PolicyLearner.forward

    def watch(self: torch.nn.Module, batch: Any) -> Any:
        if self.training:
            seen.append(batch)
        return forward(self, batch)

    learner.PolicyLearner.forward = watch
    try:
        yield seen
    finally:
        learner.PolicyLearner.forward = forward


@functools.cache
def demonstrations() -> Path:
    """Generate three demonstrations of every task of level train."""
    folder = Path(tempfile.mkdtemp(prefix="frozen-")) / "demos"
    run("generate", "--tasks=all", "--episodes=3", "--workers=1", f"--out={folder}")
    return folder


def train(preset: str, *settings: str, out: Path | None = None) -> Path:
    """Train with a recipe, and return the run folder."""
    with tempfile.TemporaryDirectory() as folder:
        out = out or Path(folder) / "run"
        given = (f"--data={demonstrations()}", f"--preset={preset}", f"--recipe={RECIPES[preset]}")
        run("train", *given, f"--out={out}", *_SHORT, *settings)
    return out


def run(*arguments: str) -> None:
    """Run a command of `openvima`, silently unless it fails."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        status = openvima_command(arguments)
    if status:
        sys.exit(f"openvima {' '.join(arguments)}: exit status {status}\n{output.getvalue()[-2000:]}")


def leaves(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    """Return what nested dataclasses and collections hold (numbers, texts, arrays, tensors), with paths."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            yield from leaves(getattr(value, field.name), f"{path}.{field.name}" if path else field.name)
    elif isinstance(value, Mapping):
        for key, item in value.items():
            yield from leaves(item, f"{path}[{key}]")
    elif isinstance(value, list | tuple):
        for number, item in enumerate(value):
            yield from leaves(item, f"{path}[{number}]")
    elif value is not None:
        yield path, value


def _bytes(value: object) -> bytes:
    """Return type, shape and content of an array or tensor, or the text of anything else."""
    if hasattr(value, "__array__"):
        array = np.ascontiguousarray(value)
        return f"{array.dtype} {array.shape}".encode() + array.tobytes()
    return repr(value).encode()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def differences(found: object, recorded: object, *, part: str) -> Iterator[str]:
    """Name what differs from the record."""
    now, before = dict(_entries(found)), dict(_entries(recorded))
    if part == "names":
        yield from (f"{name} is gone" for name in sorted(set(_names(recorded)) - set(_names(found))))
        return
    for path in sorted(now.keys() | before.keys()):
        one, other = now.get(path), before.get(path)
        if part == "outcomes" and isinstance(one, str) and isinstance(other, str):
            other = " ".join(other.split()[: len(one.split())])  # fewer episodes may be played
        if isinstance(one, float) and isinstance(other, float):
            if abs(one - other) > TOLERANCE * max(1.0, abs(other)):
                yield f"{path}: {one:.8g} instead of {other:.8g}"
        elif one != other:
            yield f"{path}: {one} instead of {other}"


def _names(names_of: Any) -> list[str]:
    return [f"{package}.{name}" for package, found in names_of.items() for name in found]


def _entries(value: object, path: str = "") -> Iterator[tuple[str, object]]:
    for name, each in leaves(value, path):
        yield name, float(each) if isinstance(each, int) and not isinstance(each, bool) else each


def main() -> int:
    """Record or compare; return 1 where something moved."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--part", default=",".join(PARTS), help="names of parts, with commas between")
    parser.add_argument("--check", action="store_true", help="compare with the record instead of writing it")
    parser.add_argument("--episodes", type=int, default=10, help="of each task and level, for outcomes")
    options = parser.parse_args()
    recorded = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
    moved = False
    for part in options.part.split(","):
        if options.check and part not in recorded:
            print(f"{part}: not recorded", flush=True)
            continue
        found = json.loads(json.dumps(PARTS[part](options)))
        if options.check:
            lines = list(differences(found, recorded[part], part=part))
            print(f"{part}: {'as recorded' if not lines else f'{len(lines)} differ'}", flush=True)
            print("".join(f"  {line}\n" for line in lines), end="", flush=True)
            moved |= bool(lines)
        else:
            recorded[part] = found
            RECORD.write_text(json.dumps(recorded, indent=1) + "\n", encoding="utf-8")
            print(f"{part}: recorded", flush=True)
    return int(moved)


if __name__ == "__main__":
    sys.exit(main())
