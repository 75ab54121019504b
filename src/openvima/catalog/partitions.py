"""Objects and textures of each task at each generalization level.

Training and L1 share their pools. L2 swaps the textures of the two roles, L3 has novel shapes and all
textures, L4 novel tasks. Beyond the benchmark are L5, L3's objects and textures among clutter, L6,
compositions of instructions, L7, referring expressions, and L8, tasks of six to twelve steps.

Source: the partition files of VIMA-Bench, with its constructor defaults filled in where they pass nothing.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from openvima.errors import ConfigError, UnknownTaskError, unknown_name
from openvima.input_files import read_json

Level = Literal["train", "L1", "L2", "L3", "L4", "L5", "L6", "L7", "L8"]

LEVELS: tuple[Level, ...] = get_args(Level)
PUBLISHED_LEVELS = LEVELS[:5]
"""Those of the benchmark; what follows is beyond it, see docs/beyond_l4.md."""
LEVEL_TITLES: dict[str, str] = {
    "L1": "placement_generalization",
    "L2": "combinatorial_generalization",
    "L3": "novel_object_generalization",
    "L4": "novel_task_generalization",
}
"""Names of the test levels in publications."""


_TABLES: dict[str, dict[str, tuple[str, ...]]] = {
    part: {name: tuple(names) for name, names in table.items()}
    for part, table in read_json(Path(__file__).with_suffix(".json")).items()
}

OBJECT_SETS = _TABLES.pop("objects")
"""Named sets of objects: D dragged, A without rotational symmetry, B bases; the rest is for the sweeps."""
TEXTURE_SETS = _TABLES.pop("textures")
"""Named sets of textures: T all light ones and its halves; C1, C2 the disjoint training sets; d with dark."""


@dataclass(frozen=True, slots=True)
class Pool:
    """Objects and textures of one task at one level, as display names.

    Args:
        dragged_objects: Objects to be moved (for sweeps: the small block), also used for distractors.
        base_objects: Objects to put something into (for sweeps: the bounds); empty if the task has none.
        dragged_textures: Textures of dragged objects.
        base_textures: Textures of bases (for sweeps: of bounds and line); empty if the task has none.
    """

    dragged_objects: tuple[str, ...]
    base_objects: tuple[str, ...]
    dragged_textures: tuple[str, ...]
    base_textures: tuple[str, ...]


# Of each task, `partitions.json` names sets of dragged objects and base objects, and of the textures of both.
_POOLS: dict[str, dict[str, Pool]] = {
    level: {
        task: Pool(*(OBJECT_SETS[name] for name in names[:2]), *(TEXTURE_SETS[name] for name in names[2:]))
        for task, names in _TABLES["train" if level == "L1" else level].items()
    }
    for level in LEVELS
}
PUBLISHED_TASKS = (*_TABLES["train"], *_TABLES["L4"])
"""The 17 tasks of the benchmark."""
PACKAGE_TASKS = tuple(dict.fromkeys(task for pools in _POOLS.values() for task in pools))
"""Those and the tasks beyond it."""


def tasks_at(level: str) -> tuple[str, ...]:
    """Return the tasks of a level, in the benchmark's order.

    Raises:
        ConfigError: There is no such level.

    Example:
        >>> len(tasks_at("L3"))
        12
    """
    return tuple(_level_pools(level))


def levels_of(task: str) -> tuple[Level, ...]:
    """Return the levels at which a task is defined, "train" first.

    Raises:
        UnknownTaskError: There is no such task.
    """
    if task not in PACKAGE_TASKS:
        raise UnknownTaskError(unknown_name("task", task, PACKAGE_TASKS))
    return tuple(level for level in LEVELS if task in _POOLS[level])


def pool(task: str, level: str) -> Pool:
    """Return the objects and textures of a task at a level.

    Args:
        task: Name of a task of the package.
        level: one of `openvima.catalog.LEVELS`.

    Raises:
        UnknownTaskError: There is no such task.
        ConfigError: There is no such level, or the task is not defined there.

    Example:
        >>> pool("rotate", "L3").dragged_objects
        ('letter R',)
    """
    levels = levels_of(task)
    pools = _level_pools(level)
    if task not in pools:
        raise ConfigError(f"{task} is not defined at level {level}; it is defined at {', '.join(levels)}.")
    return pools[task]


def _level_pools(level: str) -> dict[str, Pool]:
    if level not in _POOLS:
        raise ConfigError(unknown_name("level", level, LEVELS))
    return _POOLS[level]
