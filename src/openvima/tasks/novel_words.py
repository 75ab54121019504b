"""Invented words: nouns, and adjectives defined by comparing objects that differ in one attribute alone."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from openvima.catalog import Vector3
from openvima.catalog.textures import NEUTRAL_TEXTURE, texture_spec
from openvima.errors import ConfigError, unknown_name
from openvima.scene import ObjectImage, Placement, Pose
from openvima.tasks.options import check_count, check_difficulty, check_num_distractors
from openvima.tasks.placing import APART_M, of_a_third_shape, place_distractors
from openvima.tasks.table import NO_SCALE, TableSampler

ADJECTIVES = ("daxer", "blicker", "modier", "kobar")
NOUNS = ("dax", "blicket", "wug", "zup")
_WORD = re.compile(r"[^\W\d_]+(-[^\W\d_]+)*")


def choose_words(
    table: TableSampler, option: str, words: str | Sequence[str], *, count: int = 1
) -> tuple[str, ...]:
    """Draw distinct words.

    Args:
        table: Source of the draws.
        option: Name of the option, for errors.
        words: A word or a list of words.
        count: Number of words.

    Raises:
        ConfigError: The list is too short, or has duplicates or invalid words.
    """
    if not isinstance(words, Iterable):
        raise ConfigError(f"{option} is {words!r}; give a word or a list of words.")
    listed = (words,) if isinstance(words, str) else tuple(words)
    wrong = [word for word in listed if not (isinstance(word, str) and _WORD.fullmatch(word))]
    if wrong or len(set(listed)) < max(len(listed), count):
        given = ", ".join(map(repr, wrong or listed)) or "nothing"
        raise ConfigError(f"{option} holds {given}; give at least {count} different words, letters only.")
    return tuple(listed[int(i)] for i in table.rng.permutation(len(listed))[:count])


def shuffle_sentences(table: TableSampler, sentences: Sequence[str]) -> list[str]:
    """Return sentences in random order."""
    return [sentences[int(i)] for i in table.rng.permutation(len(sentences))]


def gray_image(placement: Placement) -> ObjectImage:
    """Return an image of the shape alone, without texture and scale."""
    return ObjectImage(replace(placement, texture=NEUTRAL_TEXTURE, scale=NO_SCALE))


MEANINGS = ("shorter", "taller", "lighter", "darker")
"""Meanings in published episodes."""
ALL_MEANINGS = (*MEANINGS, "smaller", "larger")
NUM_COMPARISONS = 3
_NO_ID = 0  # of objects in the prompt only
_ORIGIN = Pose((0.0, 0.0, 0.0))  # object images have a pose of their own


@dataclass(frozen=True, slots=True)
class Attribute:
    """One side of a comparison: scale and shade of an object.

    Args:
        scale: Factor per axis.
        shade: Variant of its texture; None: unchanged.
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
class AdjectiveExample:
    """Comparisons that define an adjective, and the attribute that the prompt asks for.

    Args:
        text: The comparisons.
        fills: Values of their slots and of the slots `adv` and `novel_adj` of the request.
        asked: Attribute of the target.
        other: Attribute of its twin.
    """

    text: str
    fills: dict[str, ObjectImage | str]
    asked: Attribute
    other: Attribute


def comparison_text(num_comparisons: int = NUM_COMPARISONS) -> str:
    """Return the comparisons, with their slots."""
    return " ".join(
        f"{{demo_blicker_obj_{n}}} is {{novel_adj}} than {{demo_less_blicker_obj_{n}}}."
        for n in range(1, num_comparisons + 1)
    )


def sample_adjective_example(
    table: TableSampler,
    *,
    adjectives: str | Sequence[str],
    meanings: str | Sequence[str],
    num_comparisons: int,
) -> AdjectiveExample:
    """Draw an adjective, its meaning, and pairs of objects that illustrate it.

    Word, meaning and whether the request says "less" are independent.

    Args:
        table: Source of objects and textures; nothing is placed.
        adjectives: Invented words to choose from.
        meanings: Possible meanings, out of `ALL_MEANINGS`.
        num_comparisons: Number of pairs, 1 … 9.

    Raises:
        ConfigError: An option is invalid, or a texture of the pool has no light and dark variant.
    """
    check_count("num_comparisons", num_comparisons, low=1, high=9)
    (adjective,) = choose_words(table, "adjectives", adjectives)
    meaning = table.choose(_checked_meanings(table, meanings))
    more, less = _attributes(table, meaning)
    is_flipped = table.choose((False, True))
    fills: dict[str, ObjectImage | str] = {"adv": "less " if is_flipped else "", "novel_adj": adjective}
    for n in range(1, num_comparisons + 1):
        object_name = table.choose(table.pool.dragged_objects)
        texture = table.choose(table.pool.dragged_textures)
        size = table.sample_size(object_name)
        for slot, attribute in ((f"demo_blicker_obj_{n}", more), (f"demo_less_blicker_obj_{n}", less)):
            fills[slot] = _image(object_name, attribute.texture(texture), size, attribute.scale)
    asked, other = (less, more) if is_flipped else (more, less)
    return AdjectiveExample(comparison_text(num_comparisons), fills, asked, other)


def place_base_and_pair(
    table: TableSampler, example: AdjectiveExample, *, num_distractors: int, difficulty: str
) -> tuple[Placement, Placement, list[Placement]]:
    """Place a base, the target and its twin, and distractors of other shapes.

    Args:
        table: Sampler of the scene.
        example: The attributes of target and twin.
        num_distractors: Distractors of any shape, bases included, besides those of the difficulty.
        difficulty: "easy"; "medium" and "hard" add an object of another shape with the attribute of the twin
            or of the target.

    Returns:
        Base, target, and all other objects, the twin first.
    """
    check_difficulty(difficulty)
    check_num_distractors(num_distractors)
    pool = table.pool
    if len(pool.dragged_objects) < 2:
        raise ConfigError(f"dragged objects are {pool.dragged_objects}; give at least two shapes.")
    base_texture, texture = table.choose(pool.base_textures), table.choose(pool.dragged_textures)
    base = table.place_one("base", lambda: (table.choose(pool.base_objects), base_texture))
    first, second = table.rng.permutation(len(pool.dragged_objects))[:2]
    shape, other_shape = pool.dragged_objects[first], pool.dragged_objects[second]
    size = table.sample_size(shape)

    def put(what: str, object_name: str, attribute: Attribute, size: Vector3 | None) -> Placement:
        appearance = (object_name, attribute.texture(texture))
        return table.place_one(what, lambda: appearance, size=size, scale=attribute.scale, apart_m=APART_M)

    target = put("target", shape, example.asked, size)
    others = [put("twin", shape, example.other, size)]
    if difficulty != "easy":
        attribute = example.asked if difficulty == "hard" else example.other
        others.append(put("object of another shape", other_shape, attribute, size if table.compat else None))
    draw = of_a_third_shape(table, base, target, (*pool.dragged_textures, *pool.base_textures))
    return base, target, others + place_distractors(table, draw, count=num_distractors)


def _attributes(table: TableSampler, meaning: str) -> tuple[Attribute, Attribute]:
    """Draw the attributes of an object that has more and of one that has less of the adjective."""
    if meaning in ("shorter", "taller"):
        height = table.rng.uniform(0.3, 0.4)
        low, high = Attribute((1.0, 1.0, height)), Attribute((1.0, 1.0, height + 2.0))
    elif meaning in ("smaller", "larger"):
        width = table.rng.uniform(0.55, 0.6)
        low, high = Attribute((width, width, 1.0)), Attribute((width + 0.4, width + 0.4, 1.0))
    else:
        low, high = Attribute(shade="light"), Attribute(shade="dark")
    return (low, high) if meaning in ("shorter", "smaller", "lighter") else (high, low)


def _image(object_name: str, texture: str, size: Vector3, scale: Vector3) -> ObjectImage:
    return ObjectImage(Placement(_NO_ID, object_name, texture, size, _ORIGIN, scale=scale))


def _checked_meanings(table: TableSampler, meanings: str | Sequence[str]) -> tuple[str, ...]:
    if not isinstance(meanings, Iterable):
        raise ConfigError(f"meanings is {meanings!r}; give some of {', '.join(ALL_MEANINGS)}.")
    listed = (meanings,) if isinstance(meanings, str) else tuple(meanings)
    for meaning in listed or ("",):
        if meaning not in ALL_MEANINGS:
            raise ConfigError(unknown_name("meaning", meaning, ALL_MEANINGS))
    if {"lighter", "darker"} & set(listed):
        specs = [texture_spec(texture) for texture in table.pool.dragged_textures]
        plain = [spec.name for spec in specs if not (spec.is_dark or spec.dark_variant)]
        if plain:
            raise ConfigError(
                f"{', '.join(plain)} have no light and dark variant, which the meanings lighter "
                f"and darker need; give other textures."
            )
    return listed
