"""Which objects demonstrations show in which textures, by task and role: a table small enough to keep.

It goes with a policy as a proof of what it saw: `training_data.json` beside the weights names the data set by
its content, and lists every combination of object and texture that occurs in it. `unseen.py` judges it.

Roles of objects on the table, as the record of an episode tells them:

dragged        picked by the oracle
base           fixed, and something is placed relative to it
distractor     free to move, but missing in the prompt's picture of the whole scene, `{scene}`, if it has one;
               the oracle may have to clear it away
other_movable  free to move, and none of these
other_fixed    fixed, and nothing is placed relative to it

`prompted` are the objects in images of prompts.
"""

import hashlib
import json
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from itertools import product
from typing import Any

import numpy as np

from openvima.data.manifest import MANIFEST_NAME
from openvima.data.reader import Dataset

Look = tuple[str, str]  # names of object and texture
Row = Mapping[str, Any]  # Any: values of an episode's columns

ROLES: tuple[str, ...] = ("dragged", "base", "distractor", "other_movable", "other_fixed", "prompted")
_PICTURE = "scene"  # name of the image that shows the whole table
_COLUMNS = ["task", "objects", "prompt_images", "pick_ids", "place_ids"]
_LIST = re.compile(r"\[(?:[^][{}]|\[[^][{}]*\])*\]")  # with at most one list in it
_FROM_MANIFEST = (
    "schema",
    "command",
    "config",
    "versions",
    "licence",
    "content_hash",
    "checksum",
    "counts",
    "index",
)


def looks_record(
    dataset: Dataset, report: Callable[[int, int, str], None] | None = None
) -> dict[str, Any]:  # Any: JSON
    """Collect what a data set shows; every shard is read, images left out.

    Args:
        dataset: The data set.
        report: Called with shards read, shards in all, and a note.

    Returns:
        `manifest`: entries of the manifest, and `sha256` of its file, by which runs know their data; `tasks`:
        for each task its episodes, steps, levels, domains, ranges of seeds (first and last), and its roles.
        Each role has the number of objects shown in it, and its looks: groups of objects that occur in all
        textures of the group but those that are lacking.

    Raises:
        ShardError: A shard is damaged.
    """
    names = dataset.shard_names()
    counts: dict[str, dict[str, Counter[Look]]] = defaultdict(lambda: defaultdict(Counter))
    for done, name in enumerate(names, start=1):
        for row in dataset.shard(name).table(_COLUMNS).to_pylist():
            roles = counts[row["task"]]
            for role, look in _roles(row):
                roles[role][look] += 1
        if report is not None:
            report(done, len(names), "")
    manifest = {name: dataset.manifest[name] for name in _FROM_MANIFEST}
    tasks = {task: {**_episodes(dataset, task), "roles": _tables(counts[task])} for task in sorted(counts)}
    sha256 = hashlib.sha256((dataset.path / MANIFEST_NAME).read_bytes()).hexdigest()
    return {"manifest": {**manifest, "sha256": sha256}, "tasks": tasks}


def looks_text(record: Mapping[str, Any]) -> str:  # Any: JSON
    """Write the record as JSON, each list of names or of ranges in one line."""
    text = json.dumps(record, indent=1, ensure_ascii=False)
    return _LIST.sub(lambda found: json.dumps(json.loads(found[0]), ensure_ascii=False), text) + "\n"


def looks_of(role: Mapping[str, Any]) -> frozenset[Look]:  # Any: JSON
    """Return all combinations of object and texture of one role of the record."""
    return frozenset(
        (name, texture)
        for group in role["looks"]
        for name, texture in product(group["objects"], group["textures"])
        if texture not in group.get("lacking", {}).get(name, ())
    )


def seeds_of(entry: Mapping[str, Any]) -> list[int]:  # Any: JSON
    """Return all seeds of one task of the record."""
    return [seed for first, last in entry["seeds"] for seed in range(first, last + 1)]


def _roles(row: Row) -> Iterator[tuple[str, Look]]:
    """Yield role and look of everything that an episode shows."""
    pictures = [image for image in row["prompt_images"] if image["name"] == _PICTURE]
    pictured = {_look(part) for image in pictures for part in image["objects"]}
    for part in row["objects"]:
        yield _role(part, row, is_pictured=not pictures or _look(part) in pictured), _look(part)
    for image in row["prompt_images"]:
        for part in image["objects"]:
            yield "prompted", _look(part)


def _role(part: Row, row: Row, *, is_pictured: bool) -> str:
    if part["fixed"]:
        return "base" if part["id"] in row["place_ids"] else "other_fixed"
    if not is_pictured:
        return "distractor"
    return "dragged" if part["id"] in row["pick_ids"] else "other_movable"


def _look(part: Row) -> Look:
    return part["object"], part["texture"]


def _episodes(dataset: Dataset, task: str) -> dict[str, Any]:  # Any: JSON
    """Which episodes of a task there are, as the index tells."""
    index = dataset.index
    rows = index.filter(np.array(index.column("task").to_pylist()) == task)
    seeds = np.unique(rows.column("seed").to_numpy())
    gaps = np.flatnonzero(np.diff(seeds) > 1)
    firsts, lasts = seeds[[0, *(gaps + 1)]], seeds[[*gaps, -1]]
    return {
        "episodes": rows.num_rows,
        "steps": int(rows.column("steps").to_numpy().sum()),
        "levels": sorted(set(rows.column("level").to_pylist())),
        "domains": sorted(set(rows.column("domain").to_pylist())),
        "seeds": np.stack([firsts, lasts], axis=1).tolist(),
    }


def _tables(roles: Mapping[str, Counter[Look]]) -> dict[str, Any]:  # Any: JSON
    return {
        role: {"shown": roles[role].total(), "looks": _grouped(roles[role])} for role in ROLES if roles[role]
    }


def _grouped(looks: Counter[Look]) -> list[dict[str, Any]]:  # Any: JSON
    """Put objects together that have most of their textures in common."""
    textures: dict[str, set[str]] = defaultdict(set)
    for name, texture in looks:
        textures[name].add(texture)
    groups: list[tuple[list[str], set[str]]] = []
    for name in sorted(textures):
        for names, union in groups:
            if 2 * len(union & textures[name]) > len(union | textures[name]):
                names.append(name)
                union |= textures[name]
                break
        else:
            groups.append(([name], set(textures[name])))
    return [_group(names, union, textures) for names, union in groups]


def _group(names: list[str], union: set[str], found: Mapping[str, set[str]]) -> dict[str, Any]:  # Any: JSON
    lacking = {name: sorted(union - found[name]) for name in names if union != found[name]}
    return {"objects": names, "textures": sorted(union), **({"lacking": lacking} if lacking else {})}
