"""Appearance statistics: combinations of object and texture in demonstrations, by task and role.

    python experiments/openvima_small/training_data.py DEMONSTRATIONS FILE.json

They document the training data of a policy: `training_data.json` beside its weights identifies the data set
by content and lists every combination in it. `find_leaks` compares it with the training partition, so that
L2, L3 and L4 stay unseen. The benchmark itself makes three exceptions at every level:

- in `visual_manipulation`, `novel_noun` and `scene_understanding` distractors have textures of either role;
- in `rearrange` and `rearrange_then_restore` the distractor has any of the 49 light textures, ten of which no
  other role has before L3;
- prompt images of a shape alone, in `novel_adj` and `novel_noun`, render it in gray.

Dragged objects, bases and all shapes keep to the partition strictly.

Roles of objects on the table:

dragged        picked by the oracle
base           fixed, and the reference of a placement
distractor     movable, but absent from the prompt's image `{scene}`, if there is one; the oracle may have to
               clear it away
other_movable  movable, and none of these
other_fixed    fixed, and the reference of no placement

`prompted` are the objects in prompt images.
"""

import hashlib
import json
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from openvima.catalog import NEUTRAL_TEXTURE, OBJECT_SETS, TEXTURE_SETS, pool, tasks_at
from openvima.data.manifest import MANIFEST_NAME
from openvima.data.reader import Dataset

Appearance = tuple[str, str]  # names of object and texture
Row = Mapping[str, Any]

ROLES: tuple[str, ...] = ("dragged", "base", "distractor", "other_movable", "other_fixed", "prompted")
_SCENE_IMAGE = "scene"  # name of the prompt image of the whole table
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


def appearance_record(dataset: Dataset) -> dict[str, Any]:
    """Collect the appearance statistics of a data set; reads every shard, without images.

    Args:
        dataset: The data set.

    Returns:
        `manifest`: entries of the manifest, and `sha256` of its file, which identifies the data of a run.
        `tasks`: episodes, steps, levels, domains, ranges of seeds (first and last) and roles of each task.
        Each role has the number of its objects and its appearances: groups of objects that occur in all
        textures of the group but those listed as lacking.

    Raises:
        DatasetError: A shard is damaged.
    """
    counts: dict[str, dict[str, Counter[Appearance]]] = defaultdict(lambda: defaultdict(Counter))
    for name in dataset.shard_names():
        for row in dataset.shard(name).table(_COLUMNS).to_pylist():
            roles = counts[row["task"]]
            for role, appearance in _list_roles(row):
                roles[role][appearance] += 1
    manifest = {name: dataset.manifest[name] for name in _FROM_MANIFEST}
    tasks = {
        task: {**_summarise_episodes(dataset, task), "roles": _make_tables(counts[task])}
        for task in sorted(counts)
    }
    sha256 = hashlib.sha256((dataset.path / MANIFEST_NAME).read_bytes()).hexdigest()
    return {"manifest": {**manifest, "sha256": sha256}, "tasks": tasks}


def appearance_text(record: Mapping[str, Any]) -> str:
    """Format the record as JSON, each list of names or ranges in one line."""
    text = json.dumps(record, indent=1, ensure_ascii=False)
    return _LIST.sub(lambda found: json.dumps(json.loads(found[0]), ensure_ascii=False), text) + "\n"


def appearances_of(role: Mapping[str, Any]) -> frozenset[Appearance]:
    """Return all combinations of object and texture of a role in the record."""
    return frozenset(
        (name, texture)
        for group in role["appearances"]
        for name, texture in product(group["objects"], group["textures"])
        if texture not in group.get("lacking", {}).get(name, ())
    )


def _list_roles(row: Row) -> Iterator[tuple[str, Appearance]]:
    """Yield role and appearance of all objects of an episode."""
    scene_images = [image for image in row["prompt_images"] if image["name"] == _SCENE_IMAGE]
    in_scene_image = {_appearance(part) for image in scene_images for part in image["objects"]}
    for part in row["objects"]:
        yield (
            _classify(part, row, is_in_scene_image=not scene_images or _appearance(part) in in_scene_image),
            _appearance(part),
        )
    for image in row["prompt_images"]:
        for part in image["objects"]:
            yield "prompted", _appearance(part)


def _classify(part: Row, row: Row, *, is_in_scene_image: bool) -> str:
    if part["fixed"]:
        return "base" if part["id"] in row["place_ids"] else "other_fixed"
    if not is_in_scene_image:
        return "distractor"
    return "dragged" if part["id"] in row["pick_ids"] else "other_movable"


def _appearance(part: Row) -> Appearance:
    return part["object"], part["texture"]


def _summarise_episodes(dataset: Dataset, task: str) -> dict[str, Any]:
    """Summarise the episodes of a task in the index."""
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


def _make_tables(roles: Mapping[str, Counter[Appearance]]) -> dict[str, Any]:
    return {
        role: {"count": roles[role].total(), "appearances": _group(roles[role])}
        for role in ROLES
        if roles[role]
    }


def _group(appearances: Counter[Appearance]) -> list[dict[str, Any]]:
    """Group objects that have most of their textures in common."""
    textures: dict[str, set[str]] = defaultdict(set)
    for name, texture in appearances:
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
    return [_describe_group(names, union, textures) for names, union in groups]


def _describe_group(names: list[str], union: set[str], found: Mapping[str, set[str]]) -> dict[str, Any]:
    lacking = {name: sorted(union - found[name]) for name in names if union != found[name]}
    return {"objects": names, "textures": sorted(union), **({"lacking": lacking} if lacking else {})}


_LEVEL = "train"
_TEXTURES_OF_EITHER_ROLE = ("visual_manipulation", "novel_noun", "scene_understanding")
_TEXTURES_OF_ALL = ("rearrange", "rearrange_then_restore")
_SHAPES_ALONE = ("novel_adj", "novel_noun")
_SWEEPS = ("sweep_without_exceeding",)  # the line is in no list of bases


def find_leaks(record: Mapping[str, Any]) -> list[str]:
    """Compare appearance statistics with the training partition.

    Args:
        record: The result of `appearance_record`.

    Returns:
        One sentence for each task, level or appearance outside the training partition.
    """
    return [problem for task, entry in record["tasks"].items() for problem in _find_problems(task, entry)]


def training_appearances(task: str) -> dict[str, frozenset[Appearance]]:
    """Return the combinations of object and texture that each role may have in demonstrations of a task.

    Raises:
        UnknownTaskError: There is no such task.
        ConfigError: It is none of the training tasks.
    """
    names = pool(task, _LEVEL)
    shapes, bases = names.dragged_objects, names.base_objects
    bases += OBJECT_SETS["constraint"] if task in _SWEEPS else ()
    dragged, base = _appearances(shapes, names.dragged_textures), _appearances(bases, names.base_textures)
    appearances = dict(zip(ROLES, (dragged, base, dragged, dragged, base, dragged | base), strict=True))
    if task in _TEXTURES_OF_EITHER_ROLE:
        either = (*names.dragged_textures, *names.base_textures)
        appearances["other_movable"], appearances["other_fixed"] = (
            _appearances(shapes, either),
            _appearances(bases, either),
        )
    if task == "scene_understanding":  # its prompt contains distractors too
        appearances["prompted"] = appearances["other_movable"] | appearances["other_fixed"]
    if task in _TEXTURES_OF_ALL:
        appearances["distractor"] = _appearances(shapes, TEXTURE_SETS["T"])
    if task in _SHAPES_ALONE:
        appearances["prompted"] |= _appearances((*shapes, *bases), (NEUTRAL_TEXTURE,))
    return appearances


def _find_problems(task: str, entry: Mapping[str, Any]) -> list[str]:
    if task not in tasks_at(_LEVEL):
        return [f"{task} is none of the training tasks."]
    problems = [f"{task} has episodes of level {level}." for level in entry["levels"] if level != _LEVEL]
    allowed = training_appearances(task)
    for role, table in entry["roles"].items():
        strange = sorted(appearances_of(table) - allowed.get(role, frozenset()))
        problems += [f"{task} shows {name!r} in {texture!r} as {role}." for name, texture in strange]
    return problems


def _appearances(objects: Iterable[str], textures: Iterable[str]) -> frozenset[Appearance]:
    return frozenset(product(objects, textures))


def main(folder: str, file: str) -> None:
    """Write the record of a data set, and print what is outside the training partition."""
    record = appearance_record(Dataset(folder))
    Path(file).write_text(appearance_text(record), encoding="utf-8")
    print(*find_leaks(record) or ["everything is inside the training partition"], sep="\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
