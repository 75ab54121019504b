"""Leakage check: whether demonstrations keep to the training partition, so that L2, L3 and L4 stay unseen.

The reference is `catalog.partitions`. The benchmark itself makes three exceptions at every level:

- in `visual_manipulation`, `novel_noun` and `scene_understanding` distractors have textures of either role;
- in `rearrange` and `rearrange_then_restore` the distractor has any of the 49 light textures, ten of which no
  other role has before L3;
- prompt images of a shape alone, in `novel_adj` and `novel_noun`, render it in gray.

Dragged objects, bases and all shapes keep to the partition strictly.
"""

from collections.abc import Iterable, Mapping
from itertools import product
from typing import Any

from openvima.catalog import NEUTRAL_TEXTURE, OBJECT_SETS, TEXTURE_SETS, pool, tasks_at
from openvima.data.appearance_stats import ROLES, Appearance, appearances_of

_LEVEL = "train"
_TEXTURES_OF_EITHER_ROLE = ("visual_manipulation", "novel_noun", "scene_understanding")
_TEXTURES_OF_ALL = ("rearrange", "rearrange_then_restore")
_SHAPES_ALONE = ("novel_adj", "novel_noun")
_SWEEPS = ("sweep_without_exceeding",)  # the line is in no list of bases


def leaks(record: Mapping[str, Any]) -> list[str]:  # Any: JSON
    """Compare appearance statistics with the training partition.

    Args:
        record: The result of `appearance_record`.

    Returns:
        One sentence for each task, level or appearance outside the training partition.
    """
    return [problem for task, entry in record["tasks"].items() for problem in _problems(task, entry)]


def training_appearances(task: str) -> dict[str, frozenset[Appearance]]:
    """Return the combinations of object and texture that each role may have in demonstrations of a task.

    Raises:
        UnknownTaskError: There is no such task.
        LevelError: It is none of the training tasks.
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


def _problems(task: str, entry: Mapping[str, Any]) -> list[str]:  # Any: JSON
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
