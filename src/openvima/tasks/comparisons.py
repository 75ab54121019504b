"""Comparisons that teach an invented adjective, and twins on the table that differ in just that respect."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from openvima.catalog import Vector3
from openvima.catalog.textures import texture_spec
from openvima.errors import ConfigError, unknown_name
from openvima.scene import ObjectImage, Placement, Pose
from openvima.tasks.into_base import APART_M, of_a_third_shape, place_distractors
from openvima.tasks.novel_words import choose_words
from openvima.tasks.options import check_count, check_difficulty
from openvima.tasks.table import NO_SCALE, TableSampler

MEANINGS = ("shorter", "taller", "lighter", "darker")
"""What an adjective means in published episodes."""
ALL_MEANINGS = (*MEANINGS, "smaller", "larger")
NUM_COMPARISONS = 3
_NO_ID = 0  # of objects that stand in the prompt only
_ORIGIN = Pose((0.0, 0.0, 0.0))  # pictures of lone objects choose the pose themselves


@dataclass(frozen=True, slots=True)
class Degree:
    """One side of a comparison: how an object is altered.

    Args:
        scale: Factor per axis.
        shade: Which variant of its texture the object has; None leaves it as it is.
    """

    scale: Vector3 = NO_SCALE
    shade: Literal["light", "dark"] | None = None

    def texture(self, name: str) -> str:
        """Return the variant of a texture."""
        if self.shade is None:
            return name
        light = texture_spec(name).light_variant
        dark = texture_spec(light).dark_variant
        return light if self.shade == "light" or dark is None else dark


@dataclass(frozen=True, slots=True)
class Lesson:
    """What the prompt teaches about an adjective, and which of two twins it asks for.

    Args:
        text: The comparisons.
        fills: What stands in their slots, and in the slots `adv` and `novel_adj` of the request.
        asked: What the twin is like that is asked for.
        other: What the other one is like.
    """

    text: str
    fills: dict[str, ObjectImage | str]
    asked: Degree
    other: Degree


def comparison_text(num_comparisons: int = NUM_COMPARISONS) -> str:
    """Return the sentences that compare two objects each, with their slots."""
    return " ".join(
        f"{{demo_blicker_obj_{n}}} is {{novel_adj}} than {{demo_less_blicker_obj_{n}}}."
        for n in range(1, num_comparisons + 1)
    )


def sample_lesson(
    table: TableSampler,
    *,
    adjectives: str | Sequence[str],
    meanings: str | Sequence[str],
    num_comparisons: int,
) -> Lesson:
    """Draw an adjective, its meaning, and pairs of objects that show it.

    Word, meaning, and whether the "less …" twin is asked for are independent of one another.

    Args:
        table: Objects and textures come from its pool; nothing is put on it.
        adjectives: Invented words to choose from.
        meanings: What they may mean, out of `ALL_MEANINGS`.
        num_comparisons: Number of pairs, 1 … 9.

    Raises:
        ConfigError: An option is not allowed, or a texture that may be drawn has no light and dark variant.
    """
    check_count("num_comparisons", num_comparisons, low=1, high=9)
    (adjective,) = choose_words(table, "adjectives", adjectives)
    meaning = table.choose(_checked_meanings(table, meanings))
    more, less = _degrees(table, meaning)
    is_flipped = table.choose((False, True))
    fills: dict[str, ObjectImage | str] = {"adv": "less " if is_flipped else "", "novel_adj": adjective}
    for n in range(1, num_comparisons + 1):
        object_name = table.choose(table.pool.dragged_objects)
        texture = table.choose(table.pool.dragged_textures)
        size = table.sample_size(object_name)
        for slot, degree in ((f"demo_blicker_obj_{n}", more), (f"demo_less_blicker_obj_{n}", less)):
            fills[slot] = _image(object_name, degree.texture(texture), size, degree.scale)
    asked, other = (less, more) if is_flipped else (more, less)
    return Lesson(comparison_text(num_comparisons), fills, asked, other)


def place_base_and_twins(
    table: TableSampler, lesson: Lesson, *, num_distractors: int, difficulty: str
) -> tuple[Placement, Placement, list[Placement]]:
    """Put a base and two twins on the table, and distractors of other shapes.

    Args:
        table: The table to lay.
        lesson: How the twins differ.
        num_distractors: Distractors of any shape, bases included, besides those of the difficulty.
        difficulty: "easy"; "medium" and "hard" add an object of another shape that in the respect of the
            comparison is like the wrong twin or like the one asked for.

    Returns:
        Base, target, and everything that the target must stay away from, the wrong twin first.
    """
    check_difficulty(difficulty)
    check_count("num_distractors", num_distractors, high=3)
    pool = table.pool
    if len(pool.dragged_objects) < 2:
        raise ConfigError(f"dragged objects are {pool.dragged_objects}; give at least two shapes.")
    base_texture, texture = table.choose(pool.base_textures), table.choose(pool.dragged_textures)
    base = table.place_one("base", lambda: (table.choose(pool.base_objects), base_texture))
    first, second = table.rng.permutation(len(pool.dragged_objects))[:2]
    shape, other_shape = pool.dragged_objects[first], pool.dragged_objects[second]
    size = table.sample_size(shape)

    def put(what: str, object_name: str, degree: Degree, size: Vector3 | None) -> Placement:
        look = (object_name, degree.texture(texture))
        return table.place_one(what, lambda: look, size=size, scale=degree.scale, apart_m=APART_M)

    target = put("target", shape, lesson.asked, size)
    others = [put("twin", shape, lesson.other, size)]
    if difficulty != "easy":
        likeness = lesson.asked if difficulty == "hard" else lesson.other
        others.append(put("object of another shape", other_shape, likeness, size if table.compat else None))
    draw = of_a_third_shape(table, base, target, (*pool.dragged_textures, *pool.base_textures))
    return base, target, others + place_distractors(table, draw, count=num_distractors)


def _degrees(table: TableSampler, meaning: str) -> tuple[Degree, Degree]:
    """Draw what an object is like to which the adjective applies more, and to which it applies less."""
    if meaning in ("shorter", "taller"):
        height = table.rng.uniform(0.3, 0.4)
        low, high = Degree((1.0, 1.0, height)), Degree((1.0, 1.0, height + 2.0))
    elif meaning in ("smaller", "larger"):
        width = table.rng.uniform(0.55, 0.6)
        low, high = Degree((width, width, 1.0)), Degree((width + 0.4, width + 0.4, 1.0))
    else:
        low, high = Degree(shade="light"), Degree(shade="dark")
    return (low, high) if meaning in ("shorter", "smaller", "lighter") else (high, low)


def _image(object_name: str, texture: str, size: Vector3, scale: Vector3) -> ObjectImage:
    return ObjectImage(Placement(_NO_ID, object_name, texture, size, _ORIGIN, scale=scale))


def _checked_meanings(table: TableSampler, meanings: str | Sequence[str]) -> tuple[str, ...]:
    listed = (meanings,) if isinstance(meanings, str) else tuple(meanings)
    for meaning in listed or ("",):
        if meaning not in ALL_MEANINGS:
            raise ConfigError(unknown_name("meaning", meaning, ALL_MEANINGS))
    if {"lighter", "darker"} & set(listed):
        specs = [texture_spec(texture) for texture in table.pool.dragged_textures]
        plain = [spec.name for spec in specs if not (spec.is_dark or spec.dark_variant)]
        if plain:
            raise ConfigError(
                f"{', '.join(plain)} come in one shade only; for the meanings lighter and darker give "
                f"textures that have a light and a dark variant."
            )
    return listed
