"""Whether damage to files of the object cache is found: random damages, each followed by reading everything.

    python benchmarks/damage_cache.py [--rounds N] [--seed S] [--json FILE]

A small cache of each kind (crops, detected boxes, whole frames) is made. In each round one of its files is
damaged and opened again, and all that it holds is read. A damage is `found` if a `ShardError` says so or the
file no longer counts as the cache of its shard, so that it is made anew; `harmless` if all that is read
equals what was written; else `wrong`. Exit status 1 if any was wrong, or failed with another error.
"""

import argparse
import json
import os
import pickle
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.object_cache.cache import Boxes, open_object_cache
from openvima.data.object_cache.cache_file import CacheFile
from openvima.errors import ShardError
from openvima.perception.objects import GROUND_TRUTH
from sim import circumstances

TASKS = ("rotate", "rearrange_then_restore", "sweep_without_exceeding")

Damage = Callable[[bytearray, np.random.Generator], None]


def flip_bit(content: bytearray, rng: np.random.Generator) -> None:
    """Flip one bit."""
    content[rng.integers(len(content))] ^= 1 << rng.integers(8)


def flip_bit_of_head(content: bytearray, rng: np.random.Generator) -> None:
    """Flip one bit of the first or last 4 kB, where formats keep what describes them."""
    place = int(rng.integers(min(len(content), 4096)))
    content[place if rng.random() < 0.5 else -1 - place] ^= 1 << rng.integers(8)


def overwrite(content: bytearray, rng: np.random.Generator) -> None:
    """Overwrite up to 4 kB with random bytes."""
    start, size = _span(content, rng)
    content[start : start + size] = rng.bytes(size)


def blank(content: bytearray, rng: np.random.Generator) -> None:
    """Overwrite up to 4 kB with zeros, as after a lost write."""
    start, size = _span(content, rng)
    content[start : start + size] = bytes(size)


def add_to_number(content: bytearray, rng: np.random.Generator) -> None:
    """Change a 32-bit number by a little, as a wrong count or offset would be."""
    start = 4 * int(rng.integers(len(content) // 4))
    number = int.from_bytes(content[start : start + 4], "little") + int(rng.choice([-64, -1, 1, 64]))
    content[start : start + 4] = (number % 2**32).to_bytes(4, "little")


def truncate(content: bytearray, rng: np.random.Generator) -> None:
    """Cut the end off."""
    del content[rng.integers(len(content)) :]


def extend(content: bytearray, rng: np.random.Generator) -> None:
    """Append random bytes."""
    content += rng.bytes(int(rng.integers(1, 4096)))


def remove(content: bytearray, rng: np.random.Generator) -> None:
    """Leave up to 4 kB out, so that the rest moves."""
    start, size = _span(content, rng)
    del content[start : start + size]


def swap_blocks(content: bytearray, rng: np.random.Generator) -> None:
    """Exchange two blocks of 512 bytes, as a file system may."""
    first, second = (512 * int(number) for number in rng.integers(len(content) // 512, size=2))
    content[first : first + 512], content[second : second + 512] = (
        content[second : second + 512],
        content[first : first + 512],
    )


DAMAGES: tuple[Damage, ...] = (
    flip_bit,
    flip_bit_of_head,
    overwrite,
    blank,
    add_to_number,
    truncate,
    extend,
    remove,
    swap_blocks,
)


def _span(content: bytearray, rng: np.random.Generator) -> tuple[int, int]:
    start = int(rng.integers(len(content)))
    return start, int(rng.integers(1, min(4096, len(content) - start) + 1))


def content_of(path: Path) -> list[bytes]:
    """Return all that a file of the object cache holds: what it is of, and its episodes."""
    file = CacheFile(path)
    about = (file.kind, file.source, file.variant, len(file), sorted(file.texts()))
    return [pickle.dumps(about), *(pickle.dumps(file[row]) for row in range(len(file)))]


def outcome_of(path: Path, whole: list[bytes]) -> str:
    """Read a damaged file; return "found", "harmless", "wrong", or the name of an unexpected error."""
    try:
        about = CacheFile(path)
        if pickle.dumps((about.kind, about.source, about.variant)) != pickle.dumps(
            pickle.loads(whole[0])[:3]
        ):
            return "found"  # it counts as one of other content, and is made anew
        return "harmless" if content_of(path) == whole else "wrong"
    except ShardError:
        return "found"
    except Exception as error:
        return type(error).__name__


def damage_files(paths: list[Path], *, rounds: int, seed: int) -> dict[str, Counter[str]]:
    """Damage files one at a time, and restore each.

    Args:
        paths: Whole files of object caches.
        rounds: Number of damages.
        seed: Decides them.

    Returns:
        Kind of damage to how often each outcome came.
    """
    rng = np.random.default_rng(seed)
    wholes = {path: (path.read_bytes(), content_of(path)) for path in paths}
    outcomes: dict[str, Counter[str]] = {damage.__name__: Counter() for damage in DAMAGES}
    for number in range(rounds):
        path = paths[int(rng.integers(len(paths)))]
        damage, (content, whole) = DAMAGES[number % len(DAMAGES)], wholes[path]
        damaged = bytearray(content)
        damage(damaged, rng)
        copy = path.with_name("damaged")  # a new file each time: the last one may still be mapped
        copy.unlink(missing_ok=True)
        copy.write_bytes(damaged)
        outcomes[damage.__name__][outcome_of(copy, whole)] += 1
    return outcomes


def make_caches(folder: Path) -> list[Path]:
    """Generate demonstrations, and write caches of every kind of them; return the files."""
    dataset = Dataset(generate(GenerateConfig(out=folder, tasks=TASKS, episodes=4, shard_size=2)))
    caches = [
        open_object_cache(dataset),
        open_object_cache(dataset, boxes=Boxes("segmentation", lambda: GROUND_TRUTH)),
        open_object_cache(dataset, "frames"),
    ]
    return [path for cache in caches for path in sorted(cache.folder.iterdir())]


def main() -> int:
    """Damage, print a table, and write it as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--rounds", type=int, default=10_000, help="damages")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    where = circumstances() | {"rounds": options.rounds, "seed": options.seed}
    print(", ".join(f"{name}: {value}" for name, value in where.items()))
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        outcomes = damage_files(make_caches(Path(name) / "demos"), rounds=options.rounds, seed=options.seed)
    totals = sum(outcomes.values(), Counter())
    for damage, counts in (*outcomes.items(), ("all", totals)):
        print(f"{damage:<18}" + ", ".join(f"{count:,} {name}" for name, count in counts.most_common()))
    print(f"{time.perf_counter() - start:.0f} s")
    if options.json:
        content: dict[str, Any] = {"outcomes": totals, "by_damage": outcomes, **where}  # Any: nested JSON
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return 0 if totals.keys() <= {"found", "harmless"} else 1


if __name__ == "__main__":
    sys.exit(main())
