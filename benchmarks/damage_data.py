"""Damage a data set at random, over and over: is all found, or harmless?

    python benchmarks/damage_data.py [--rounds N] [--seed S] [--json FILE]

Each round damages one file of a small data set, a shard, manifest or index: flipped bits, overwritten,
exchanged, lost, added or cut bytes. Then all episodes are read, as training does, and the folder is verified.
A round is "found" if reading ends with an error of the package or `verify` names a problem, and "harmless" if
all episodes have the content hashes that they had and `verify` agrees. Anything else is a failure: wrong
content, an error of another kind, damage that `verify` does not name, or another file that changed.

Every tenth round forges names instead: manifest and index get a hostile name of a shard, with all checksums
right. They must be refused, and nothing may be written.
"""

import argparse
import hashlib
import json
import random
import tempfile
import time
from collections import Counter
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from damage import BLOCKS, damaged
from openvima.data import Dataset, GenerateConfig, generate
from openvima.data.manifest import INDEX_NAME, MANIFEST_NAME, manifest_checksum
from openvima.data.object_cache import open_object_cache
from openvima.data.subsets import MergeConfig, merge
from openvima.data.verification import VerifyConfig, verify
from openvima.errors import DatasetError, OpenVimaError
from sim import circumstances

TASKS = ("rotate", "sweep_without_exceeding")
HOSTILE = ("../{}", "/tmp/{}", "sub/{}", "..\\{}", "", ".", "..", "a\0{}", ".{}", "~/{}", "{}/../../{}")


def outcome(folder: Path, expected: list[str]) -> str:
    """Read and verify a folder; return "found …", "harmless" or what went wrong."""
    try:
        found = "" if [demo.content_hash() for demo in Dataset(folder)] == expected else "wrong content"
    except OpenVimaError:
        found = "found by reading"
    except Exception as error:  # what the benchmark looks for
        found = f"odd error: {type(error).__name__}: {error}"
    try:
        is_clean = verify(folder, VerifyConfig(replay=0)).is_clean
    except OpenVimaError:
        is_clean = False
    except Exception as error:  # likewise
        return f"odd error of verify: {type(error).__name__}: {error}"
    if is_clean:
        return f"{found}, missed by verify" if found else "harmless"
    return found or "found by verify"


def forge(folder: Path, name: str) -> None:
    """Give a shard another name in manifest and index, and make all checksums right."""
    manifest = json.loads((folder / MANIFEST_NAME).read_bytes())
    old = min(manifest["shards"])
    manifest["shards"][name] = manifest["shards"].pop(old)
    index = pq.read_table(folder / INDEX_NAME)
    names = [name if shard == old else shard for shard in index.column("shard").to_pylist()]
    place = index.column_names.index("shard")
    index = index.set_column(place, index.schema.field("shard"), pa.array(names))
    pq.write_table(index, folder / INDEX_NAME)
    content = (folder / INDEX_NAME).read_bytes()
    manifest["index"] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    manifest["checksum"] = manifest_checksum(manifest)
    (folder / MANIFEST_NAME).write_text(json.dumps(manifest))


def forged_outcome(folder: Path, rng: random.Random) -> str:
    """Forge a name and run what follows names; return "found by reading" or what went wrong."""
    forge(folder, rng.choice(HOSTILE).format(*["x.arrow"] * 2))
    commands = (
        lambda: list(Dataset(folder)),
        lambda: open_object_cache(Dataset(folder)),
        lambda: merge(MergeConfig((folder,), folder.parent / "merged")),
    )
    for command in commands:
        try:
            command()
        except DatasetError:
            continue
        except Exception as error:  # what the benchmark looks for
            return f"odd error: {type(error).__name__}: {error}"
        return "hostile name followed"
    return "found by reading"


def main() -> None:
    """Damage, count, print, and write the counts as JSON if asked."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--rounds", type=int, default=3000, help="number of damages")
    parser.add_argument("--seed", type=int, default=0, help="of the damages")
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    counts: dict[str, Counter[str]] = {}
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        folder = generate(GenerateConfig(Path(name) / "data", TASKS, episodes=2, shard_size=1))
        whole = {path: path.read_bytes() for path in sorted(folder.iterdir())}
        expected = [demo.content_hash() for demo in Dataset(folder)]
        for number in range(options.rounds):
            rng = random.Random(f"{options.seed} {number}")
            if number % 10 == 9:
                kind, found = "forged name", forged_outcome(folder, rng)
            else:
                path = rng.choice([p for p in whole if p.suffix != ".arrow"] + [rng.choice(list(whole))])
                kind = "shard" if path.suffix == ".arrow" else path.name
                path.write_bytes(damaged(whole[path], rng, blocks=(*BLOCKS, 4096), cut_prob=1))
                found = outcome(folder, expected)
                if path.read_bytes() == whole[path]:
                    found = "harmless"  # the accidents undid each other
            counts.setdefault(kind, Counter())[found] += 1
            for path, content in whole.items():
                path.write_bytes(content)
            if others := set(folder.iterdir()) - whole.keys() | set(folder.parent.iterdir()) - {folder}:
                counts[kind][f"wrote {min(others)}"] += 1
                break
    good = {"found by reading", "found by verify", "harmless"}
    failures = sum(n for found in counts.values() for cause, n in found.items() if cause not in good)
    for kind in sorted(counts):
        print(f"{kind:<16}{dict(counts[kind].most_common())}")
    print(f"{options.rounds} rounds in {time.perf_counter() - start:.0f} s, {failures} failures")
    if options.json:
        content = {"rounds": options.rounds, "seed": options.seed, "failures": failures, **circumstances()}
        content["outcomes"] = {kind: dict(found) for kind, found in sorted(counts.items())}
        options.json.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    raise SystemExit(bool(failures))


if __name__ == "__main__":
    main()
