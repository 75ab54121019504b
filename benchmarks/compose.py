"""Composed scenes: whether random ones are played or refused with a reason, and hostile files refused.

    python benchmarks/compose.py [--rounds N] [--hostile N] [--seed S] [--json FILE]

Each round composes a random scene, some of it outside the workspace or overlapping, saves and loads it, and
takes two random actions in it. It is `played`, or `refused` by an error that names the object and the limit;
anything else is a failure. Each hostile file is a valid episode file with one random attack; it has to be
refused by an error of the package. Exit status 1 after a failure.
"""

import argparse
import copy
import json
import os
import random
import re
import struct
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import yaml
from PIL import Image

import openvima
from openvima.catalog import OBJECTS, TEXTURES
from openvima.errors import OpenVimaError
from openvima.tasks import sample_episode
from sim import circumstances

Values = dict[str, Any]

SLOTS = ("a", "b", "c")
TASKS = ("rotate", "novel_adj", "follow_motion", "sweep_without_touching", "rearrange_then_restore")
NAMED = re.compile(r"(object|image|goal) ('\w+'|\d+)")  # how errors name what is wrong
LIMIT = re.compile(
    r"must lie|at most|is allowed|give a number|it must be more than|multiple of|is fixed|only a small block"
)


def random_scene(rng: random.Random) -> Values:
    """Arguments of `compose` for a random scene; many are impossible."""
    spatula = rng.random() < 0.15
    names = ["small block", "three-sided rectangle", "line"] if spatula else list(OBJECTS)
    careful = rng.random() < 0.7  # apart and inside, so that most of these scenes are possible
    cells = rng.sample([(x, y) for x in (0.38, 0.62) for y in (-0.36, -0.12, 0.12, 0.36)], 6)
    objects: dict[str, Any] = {}
    for handle, (x, y) in zip("abcdef"[: rng.randint(1, 6)], cells, strict=False):
        position = [rng.uniform(0.22, 0.78), rng.uniform(-0.52, 0.52)]
        if careful:
            position = [x + rng.uniform(-0.01, 0.01), y + rng.uniform(-0.01, 0.01)]
        placed = [rng.choice(names), rng.choice(list(TEXTURES)), position]
        objects[handle] = placed
        if rng.random() < 0.5:
            placed.append(rng.uniform(-180, 180))
        elif rng.random() < 0.4:
            fields = dict(zip(("object", "texture", "position"), placed, strict=False))
            objects[handle] = {**fields, "scale": rng.uniform(0.45, 1.3), "fixed": rng.random() < 0.5}
    handles = list(objects)
    images = {slot: _random_image(rng, handles) for slot in SLOTS[: rng.randint(0, 3)]}
    prompt = "Do this: " + " then ".join(f"{{{slot}}}" for slot in images)
    goals = []
    if len(handles) > 1 and rng.random() < 0.5:
        one, other = rng.sample(handles, 2)
        position = [rng.uniform(0.22, 0.78), rng.uniform(-0.52, 0.52)]
        ways = [["in", one, other], ["at", one, position], ["rotated", one, rng.uniform(-360, 360)]]
        goals = [["swept_into", one, other] if spatula else rng.choice(ways)]
    end_effector = "spatula" if spatula else "suction"
    return {
        "objects": objects,
        "images": images,
        "goals": goals,
        "max_steps": rng.randint(1, 20),
        "end_effector": end_effector,
        "prompt": prompt,
    }


def _random_image(rng: random.Random, handles: list[str]) -> Any:  # Any: one of the forms of an image
    handle = rng.choice(handles)
    appearance = [rng.choice(list(OBJECTS)), rng.choice(list(TEXTURES))]
    position = [rng.uniform(0.3, 0.7), rng.uniform(-0.45, 0.45)]
    return rng.choice([handle, appearance, [[handle, position]], [[*appearance, position, 30.0]]])


def outcome_of(values: Values, rng: random.Random, env: openvima.TabletopEnv, folder: Path) -> str:
    """Compose, save, load and play a scene; return "played", "refused" or what went wrong."""
    try:
        episode = openvima.compose(**values)
    except OpenVimaError as error:
        is_explained = NAMED.search(str(error)) and LIMIT.search(str(error))
        return "refused" if is_explained else f"refused without object or limit: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    try:
        if openvima.load_episode(openvima.save_episode(episode, folder / "scene.yaml")) != episode:
            return "changed by saving"
        env.reset(options={"episode": episode})
        assert env.prompt.text == values["prompt"]
        for _ in range(min(2, episode.max_steps)):
            low, high = (0.25, -0.5), (0.75, 0.5)
            points = [np.float32([rng.uniform(*ends) for ends in zip(low, high, strict=True)]) for _ in "01"]
            turned = np.float32([0, 0, 0, 1])
            action = {"pose0_position": points[0], "pose1_position": points[1]}
            *_, terminated, _, info = env.step(action | {"pose0_rotation": turned, "pose1_rotation": turned})
            if terminated and not episode.problem.goals:
                return f"ended without goals: {info['reason']}"
            if terminated:
                break
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "played"


def valid_files() -> list[Values]:
    """Values of valid episode files: one written by hand, and sampled ones."""
    by_hand = {
        "objects": {"x": ["heart", "red swirl", [0.5, -0.2], 30.0], "y": ["bowl", "green", [0.5, 0.2]]},
        "images": {"a": "x", "b": ["bowl", "green"], "c": [["x", [0.5, 0.1]]]},
        "goals": [["in", "x", "y"], ["at", "x", [0.4, 0.1], 45.0]],
        "max_steps": 5,
        "prompt": "Put the {a} into the {b} like {c}.",
    }
    sampled = []
    with tempfile.TemporaryDirectory() as folder:
        for task in TASKS:
            path = openvima.save_episode(sample_episode(task, seed=0), Path(folder, "episode.yaml"))
            sampled.append(yaml.safe_load(path.read_text(encoding="utf-8")))
    return [by_hand] * len(sampled) + sampled


NUMBERS = (float("nan"), float("inf"), -float("inf"), 1e308, -12345.678, 10**30)
TEXTS = ("../../etc/passwd", "x" * 5000, "a\x1b[2Jb", "")


def wrong_leaf(values: Values, rng: random.Random) -> Values:
    """Replace a number or text by one that is not possible there, or by a structure."""
    values = copy.deepcopy(values)
    holders = [holder for holder in _holders(values) if holder]
    while True:
        holder = rng.choice(holders)
        key = rng.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
        if isinstance(holder[key], dict | list) or holder[key] is None:
            continue
        replacements = TEXTS if isinstance(holder[key], str) else NUMBERS
        holder[key] = rng.choice([*replacements, {"x": 1}, [[0.0] * 9] * 300])
        return values


def _holders(value: Any) -> list[Any]:  # Any: plain values
    inner = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [
        *([value] if isinstance(value, dict | list) else []),
        *(h for each in inner for h in _holders(each)),
    ]


def unknown_field(values: Values, rng: random.Random) -> Values:
    """Add a field that nobody reads."""
    values = copy.deepcopy(values)
    holder = rng.choice([values, values.get("problem", values)])
    holder[rng.choice(("import", "__class__", "code", "../objects"))] = "os.system"
    return values


def missing_field(values: Values, rng: random.Random) -> Values:
    """Leave out a field that is needed."""
    needed = (
        ("objects", "prompt") if "objects" in values else ("task", "level", "domain", "seed", "max_steps")
    )
    values = copy.deepcopy(values)
    del values[rng.choice(needed)]
    return values


def too_many(values: Values, rng: random.Random) -> Values:
    """Repeat the objects, with other names or ids."""
    values = copy.deepcopy(values)
    if "objects" in values:
        first = next(iter(values["objects"].values()))
        values["objects"] |= {f"n{i}": first for i in range(rng.choice((2, 70, 2000)))}
    else:
        placements = values["problem"]["scene"]["placements"]
        placements += [{**placements[0], "id": 100 + i} for i in range(rng.choice((70, 150, 2000)))]
    return values


def as_text(values: Values) -> str:
    """A file as a user would write it."""
    return yaml.safe_dump(values, sort_keys=False, default_flow_style=None)


def damaged_text(values: Values, rng: random.Random) -> bytes:
    """Attack the file itself."""
    text = as_text(values)
    attacks: list[Callable[[], bytes]] = [
        lambda: b"a: &a [1, 1]\nb: &b [*a, *a]\nc: [*b, *b]\n" + text.encode(),
        lambda: text.replace(
            "prompt:", "prompt: !!python/object/apply:os.system ['true']\nother:", 1
        ).encode(),
        lambda: (text + "deep: " + "[" * 4000 + "]" * 4000).encode(),
        lambda: text[: len(text) // 3].encode(),
        lambda: text.encode("utf-16"),
        lambda: rng.randbytes(2000),
        lambda: text.encode() + b"\n# " + b"x" * 2**20,
        lambda: b"- " + text.encode().replace(b"\n", b"\n  "),
        lambda: b"",
        lambda: text.encode() + b"\n---\n" + text.encode(),
        lambda: ("{" * 100_000).encode(),
        lambda: (text + "? [1, 2]\n: 3\n").encode(),
        lambda: (text + "2020-01-01: 3\n").encode(),
    ]
    return rng.choice(attacks)()


def photo_attack(values: Values, rng: random.Random, folder: Path) -> Values:
    """Name a PNG file that must not be read."""
    outside = folder.parent / f"{folder.name}-outside.png"
    Image.new("RGB", (9, 9), "red").save(outside)
    for name, content in {
        "bomb.png": _png_header(60_000, 60_000),
        "cut.png": outside.read_bytes()[:40],
        "text.png": b"hello",
        "empty.png": b"",
    }.items():
        (folder / name).write_bytes(content)
    Image.new("RGB", (9, 9), "white").save(folder / "white.png")
    Image.new("RGB", (9, 9), "red").save(folder / "jpeg.png", format="JPEG")
    for name in ("link.png", "pipe.png", "folder.png"):
        path = folder / name
        if not os.path.lexists(path):
            {"link.png": lambda p: p.symlink_to(outside), "pipe.png": os.mkfifo, "folder.png": os.mkdir}[
                name
            ](path)
    names = [path.name for path in folder.glob("*.png")] + [
        f"../{outside.name}",
        str(outside),
        f"sub/../../{outside.name}",
        "missing.png",
        "/dev/zero.png",
        "x" * 300 + ".png",
        "a\0b.png",
    ]
    return {**copy.deepcopy(values), "images": {"a": rng.choice(sorted(names)), "b": "y", "c": "x"}}


def _png_header(width: int, height: int) -> bytes:
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))


def hostile_file(files: list[Values], rng: random.Random, folder: Path) -> tuple[str, Path]:
    """Write a hostile episode file; return the name of the attack and the file."""
    values, path = rng.choice(files), folder / "scene.yaml"
    attack = rng.choice(
        (wrong_leaf, wrong_leaf, unknown_field, missing_field, too_many, damaged_text, photo_attack)
    )
    if attack is damaged_text:
        path.write_bytes(damaged_text(values, rng))
    elif attack is photo_attack:
        path.write_text(as_text(photo_attack(files[0], rng, folder)), encoding="utf-8")
    else:
        path.write_text(as_text(attack(values, rng)), encoding="utf-8")
    return attack.__name__, path


def answer_to(path: Path) -> str:
    """Load a hostile file; return "refused" or what went wrong."""
    try:
        openvima.load_episode(path)
    except OpenVimaError as error:
        return "refused" if len(str(error)) < 1000 and "\n" not in str(error) else "refused at length"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "accepted"


def main() -> int:
    """Run all rounds and print what came of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=500)
    parser.add_argument("--hostile", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    rng, began = random.Random(options.seed), time.perf_counter()
    env = openvima.TabletopEnv("visual_manipulation")
    outcomes: Counter[str] = Counter()
    attacks: dict[str, Counter[str]] = {}
    failures, slowest_s = [], 0.0
    where = circumstances()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name, "inside")
        folder.mkdir()
        for number in range(options.rounds):
            outcome = outcome_of(random_scene(rng), rng, env, folder)
            outcomes[outcome if outcome in ("played", "refused") else "failed"] += 1
            failures += [] if outcome in ("played", "refused") else [f"scene {number}: {outcome[:300]}"]
        files = valid_files()
        for number in range(options.hostile):
            attack, path = hostile_file(files, rng, folder)
            start = time.perf_counter()
            answer = answer_to(path)
            slowest_s = max(slowest_s, time.perf_counter() - start)
            attacks.setdefault(attack, Counter())[answer if answer == "refused" else "failed"] += 1
            if answer != "refused":
                content = path.read_text(encoding="utf-8", errors="replace")[:3000]
                failures.append(f"hostile file {number}: {attack}: {answer[:300]}: {content}")
    result = {
        "command": f"python benchmarks/compose.py --rounds {options.rounds} --hostile {options.hostile}",
        "seed": options.seed,
        "scenes": dict(outcomes),
        "hostile": {attack: dict(counts) for attack, counts in sorted(attacks.items())},
        "slowest_answer_s": round(slowest_s, 2),
        "seconds": round(time.perf_counter() - began),
        "failures": failures,
        **where,
    }
    print(json.dumps(result, indent=1))
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
