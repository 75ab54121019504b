"""Whether demonstrations keep to the training partition, so that L2, L3 and L4 stay unseen.

Measured against `catalog.partitions`. Three kinds of object are beside the roles of a partition, because the
benchmark draws them so at every level, training included:

- in `visual_manipulation`, `novel_noun` and `scene_understanding` distractors have textures of either role;
- in `rearrange` and `rearrange_then_restore` the distractor has any of the 49 light textures, ten of which no
  other role has before L3;
- images of prompts that show a shape alone, in `novel_adj` and `novel_noun`, show it in gray.

What is dragged, what it is put into, and all shapes keep to the partition strictly.
"""

from collections.abc import Iterable, Mapping
from itertools import product
from typing import Any

from openvima.catalog import NEUTRAL_TEXTURE, OBJECT_SETS, TEXTURE_SETS, pool, tasks_at
from openvima.data.appearance_stats import ROLES, Look, looks_of

_LEVEL = "train"
_TEXTURES_OF_EITHER_ROLE = ("visual_manipulation", "novel_noun", "scene_understanding")
_TEXTURES_OF_ALL = ("rearrange", "rearrange_then_restore")
_SHAPES_ALONE = ("novel_adj", "novel_noun")
_SWEEPS = ("sweep_without_exceeding",)  # whose line stands in no list of bases


def beyond_training(record: Mapping[str, Any]) -> list[str]:  # Any: JSON
    """Compare what a data set shows with the training partition.

    Args:
        record: As `looks_record` returns it.

    Returns:
        What does not belong there, a sentence each: tasks, levels, and for each role looks; empty if all is
        from the training partition.
    """
    return [problem for task, entry in record["tasks"].items() for problem in _problems(task, entry)]


def training_looks(task: str) -> dict[str, frozenset[Look]]:
    """Return the combinations of object and texture that each role may have in demonstrations of a task.

    Raises:
        UnknownTaskError: There is no such task.
        LevelError: It is none of the training tasks.
    """
    names = pool(task, _LEVEL)
    shapes, bases = names.dragged_objects, names.base_objects
    bases += OBJECT_SETS["constraint"] if task in _SWEEPS else ()
    dragged, base = _looks(shapes, names.dragged_textures), _looks(bases, names.base_textures)
    looks = dict(zip(ROLES, (dragged, base, dragged, dragged, base, dragged | base), strict=True))
    if task in _TEXTURES_OF_EITHER_ROLE:
        either = (*names.dragged_textures, *names.base_textures)
        looks["other_movable"], looks["other_fixed"] = _looks(shapes, either), _looks(bases, either)
    if task == "scene_understanding":  # its prompt shows distractors, too
        looks["prompted"] = looks["other_movable"] | looks["other_fixed"]
    if task in _TEXTURES_OF_ALL:
        looks["distractor"] = _looks(shapes, TEXTURE_SETS["T"])
    if task in _SHAPES_ALONE:
        looks["prompted"] |= _looks((*shapes, *bases), (NEUTRAL_TEXTURE,))
    return looks


def _problems(task: str, entry: Mapping[str, Any]) -> list[str]:  # Any: JSON
    if task not in tasks_at(_LEVEL):
        return [f"{task} is none of the training tasks."]
    problems = [f"{task} has episodes of level {level}." for level in entry["levels"] if level != _LEVEL]
    allowed = training_looks(task)
    for role, table in entry["roles"].items():
        strange = sorted(looks_of(table) - allowed.get(role, frozenset()))
        problems += [f"{task} shows {name!r} in {texture!r} as {role}." for name, texture in strange]
    return problems


def _looks(objects: Iterable[str], textures: Iterable[str]) -> frozenset[Look]:
    return frozenset(product(objects, textures))
