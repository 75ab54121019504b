"""Objects and textures of each task at each generalization level.

Training and L1 share their pools. L2 swaps the textures of the two roles, L3 has novel shapes and all
textures, L4 novel tasks. Beyond the benchmark are L5, L3's objects and textures among clutter, L6,
compositions of instructions, L7, referring expressions, and L8, tasks of six to twelve steps.

Source: the partition files of VIMA-Bench, with its constructor defaults filled in where they pass nothing.
"""

from dataclasses import dataclass
from typing import Literal, get_args

from openvima.catalog.textures import TEXTURES
from openvima.errors import ConfigError, UnknownTaskError, unknown_name

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


def _names(text: str) -> tuple[str, ...]:
    return tuple(text.split(", "))


_LETTERS = tuple(f"letter {letter}" for letter in "AEGMTV")
_ALL_LETTERS = tuple(f"letter {letter}" for letter in "AEGMRTV")
_ADJECTIVE_TRAIN = (*_LETTERS, "cross", "triangle", "flower", "heart", "ring", "pentagon", "L-shaped block")
_NOVEL = ("letter R", "diamond", "hexagon", "round", "star")
_ALL_KIT = (
    *("L-shaped block", *_ALL_LETTERS, "cross", "diamond", "triangle", "flower", "heart"),
    *("hexagon", "pentagon", "ring", "round", "star"),
)

OBJECT_SETS: dict[str, tuple[str, ...]] = {
    "D_train": (*_LETTERS, "block", *_ADJECTIVE_TRAIN[len(_LETTERS) :]),
    "A_train": (*_LETTERS, "heart", "L-shaped block"),
    "D_adj": _ADJECTIVE_TRAIN,
    "D_shape": ("shorter block", *_ADJECTIVE_TRAIN),
    "B_train": ("bowl", "frame", "container", "square"),
    "D_novel": _NOVEL,
    "A_novel": ("letter R",),
    "D_shape_novel": ("shorter block", *_NOVEL),
    "B_novel": ("pallet", "pan"),
    "B_pallet": ("pallet",),
    "D_all_motion": ("block", *_ALL_KIT),
    "D_all_minus_block": _ALL_KIT,
    "D_all_texture": ("shorter block", *_ALL_KIT),
    "D_named": tuple(name for name in ("block", *_ALL_KIT) if name not in ("L-shaped block", "round")),
    "B_all": ("pan", "bowl", "frame", "square", "container", "pallet"),
    "B_all_texture": ("pan", "bowl", "container", "frame", "pallet", "square"),
    "swept": ("small block",),
    "bounds": ("three-sided rectangle",),
    "constraint": ("line",),
    "none": (),
}
"""Named sets of objects: D dragged, A without rotational symmetry, B bases; the rest is for the sweeps."""

_LIGHT = tuple(spec.name for spec in TEXTURES.values() if not spec.is_dark)
_LIGHT_PLAIN = tuple(name for name in _LIGHT if TEXTURES[name].category == "plain")
_WITH_DARK = tuple(
    name
    for name in (*_LIGHT_PLAIN, *(name for name in _LIGHT if name not in _LIGHT_PLAIN))
    if TEXTURES[name].dark_variant
)
_C1 = _names(
    "red, green, yellow, granite, polka dot, tiger, rainbow, red and yellow stripe, yellow and green "
    "stripe, red and yellow polka dot, red and green polka dot, red and blue polka dot, yellow and blue "
    "polka dot, green and blue polka dot, red swirl, green swirl, red paisley, yellow paisley, green "
    "paisley"
)
_C2 = _names(
    "blue, purple, cyan, olive, tiles, wooden, plastic, checkerboard, red and blue stripe, yellow and "
    "blue stripe, red and purple stripe, yellow and purple stripe, green and purple stripe, blue and "
    "purple stripe, yellow and purple polka dot, green and purple polka dot, blue and purple polka dot, "
    "purple swirl, blue swirl, blue paisley"
)


def _with_dark_variants(names: tuple[str, ...]) -> tuple[str, ...]:
    """Each name that has a dark variant, directly followed by it."""
    return tuple(
        variant
        for name in names
        if (dark := TEXTURES[name].dark_variant) is not None
        for variant in (name, dark)
    )


def _plain_first(names: tuple[str, ...]) -> tuple[str, ...]:
    """Order of C1d in the benchmark: plain light, plain dark, patterns light, patterns dark."""
    return tuple(sorted(names, key=lambda n: (TEXTURES[n].category != "plain", TEXTURES[n].is_dark)))


TEXTURE_SETS: dict[str, tuple[str, ...]] = {
    "T": _LIGHT,
    "T_first": _LIGHT[: len(_LIGHT) // 2],
    "T_second": _LIGHT[len(_LIGHT) // 2 :],
    "LD": _with_dark_variants(_WITH_DARK),
    "C1": _C1,
    "C2": _C2,
    "C1d": _plain_first(_with_dark_variants(_C1)),
    "C2d": _with_dark_variants(_C2),
    "none": (),
}
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


_SetNames = tuple[str, str, str, str]  # dragged objects, base objects, dragged textures, base textures

_TRAIN: dict[str, _SetNames] = {
    "sweep_without_exceeding": ("swept", "bounds", "C1", "C2"),
    "rotate": ("A_train", "none", "C1", "none"),
    "scene_understanding": ("D_train", "B_train", "C1", "C2"),
    "visual_manipulation": ("D_train", "B_train", "C1", "C2"),
    "twist": ("A_train", "none", "C1", "none"),
    "novel_adj": ("D_adj", "B_train", "C1d", "C2"),
    "novel_noun": ("D_train", "B_train", "C1", "C2"),
    "follow_order": ("D_train", "none", "C1", "none"),
    "rearrange": ("D_train", "none", "C1", "none"),
    "manipulate_old_neighbor": ("D_train", "B_train", "C1", "C2"),
    "pick_in_order_then_restore": ("D_train", "B_train", "C1", "C2"),
    "rearrange_then_restore": ("D_train", "none", "C1", "none"),
    "same_shape": ("D_shape", "B_train", "C1", "C2"),
}
_OTHER_TEXTURES = {"C1": "C2", "C2": "C1", "C1d": "C2d", "none": "none"}
_L2: dict[str, _SetNames] = {
    task: (dragged, base, _OTHER_TEXTURES[dragged_textures], _OTHER_TEXTURES[base_textures])
    for task, (dragged, base, dragged_textures, base_textures) in _TRAIN.items()
}
_L3: dict[str, _SetNames] = {
    "rotate": ("A_novel", "none", "T", "none"),
    "scene_understanding": ("D_novel", "B_novel", "T_first", "T_second"),
    "visual_manipulation": ("D_novel", "B_novel", "T_first", "T_second"),
    "twist": ("A_novel", "none", "T", "none"),
    "novel_adj": ("D_novel", "B_novel", "LD", "T_second"),
    "novel_noun": ("D_novel", "B_novel", "T_first", "T_second"),
    "follow_order": ("D_novel", "none", "T", "none"),
    "rearrange": ("D_novel", "none", "T", "none"),
    "manipulate_old_neighbor": ("D_novel", "B_novel", "T_first", "T_second"),
    "pick_in_order_then_restore": ("D_novel", "B_pallet", "T_first", "T_second"),
    "rearrange_then_restore": ("D_novel", "none", "T", "none"),
    "same_shape": ("D_shape_novel", "B_novel", "T_first", "T_second"),
}
_L4: dict[str, _SetNames] = {
    "sweep_without_touching": ("swept", "bounds", "T_first", "T_second"),
    "novel_adj_and_noun": ("D_all_minus_block", "B_all", "LD", "T_second"),
    "follow_motion": ("D_all_motion", "none", "T", "none"),
    "same_texture": ("D_all_texture", "B_all_texture", "T_first", "T_second"),
}
_L5: dict[str, _SetNames] = {
    task: _L3.get(task, ("swept", "bounds", "T_first", "T_second")) for task in _TRAIN
}
_COMPOSITIONS = _names(
    "put_then_put, put_then_rotate, rotate_then_put, rotate_then_rotate, gather_then_rotate, "
    "gather_then_put, rearrange_then_put, rotate_then_put_it, put_then_put_it, put_then_restore, "
    "put_then_neighbor, define_then_rotate_and_put, define_then_put_and_rotate, rotate_put_it_restore, "
    "put_rotate_put, put_neighbor_rotate, gather_rotate_put_it, define_rotate_put_it_restore"
)
_L6: dict[str, _SetNames] = dict.fromkeys(_COMPOSITIONS, ("D_all_motion", "B_all", "T_first", "T_second"))
_REFERRING = _names(
    "refer_by_relation, refer_by_superlative, refer_by_exception, refer_by_number, refer_by_alternative"
)
_L7: dict[str, _SetNames] = dict.fromkeys(_REFERRING, ("D_named", "B_all", "T_first", "T_second"))
_L8: dict[str, _SetNames] = {
    "build_pattern": ("D_all_motion", "none", "T", "none"),
    "imitate_then_undo": ("D_all_motion", "none", "T", "none"),
    "reverse_order": ("D_all_motion", "none", "T", "none"),
    "sort_by_shape": ("D_all_motion", "B_all", "T_first", "T_second"),
    "sort_by_texture": ("D_all_motion", "B_all", "T_first", "T_second"),
}


def _pools(table: dict[str, _SetNames]) -> dict[str, Pool]:
    return {
        task: Pool(*(OBJECT_SETS[name] for name in names[:2]), *(TEXTURE_SETS[name] for name in names[2:]))
        for task, names in table.items()
    }


_TABLES = (_TRAIN, _TRAIN, _L2, _L3, _L4, _L5, _L6, _L7, _L8)
_POOLS = {level: _pools(table) for level, table in zip(LEVELS, _TABLES, strict=True)}
PUBLISHED_TASKS = (*_TRAIN, *_L4)
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
