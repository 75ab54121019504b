"""Grammar of level L7: phrases that refer to objects, and what each means on a table.

A sentence is a command with a phrase in it, as in "Put the star left of the {object_1} into the {base}." The
words of relations are those of someone who looks at the pictures: left is smaller y, and in front is larger
x, which is lower in both views. A filling of a phrase counts only where its meaning is clear: what is meant
fits a narrow reading, and nothing else of its kind a wide one.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from openvima.catalog import TEXTURES
from openvima.scene import ObjectImage, Placement
from openvima.tasks.table import offset

AHEAD_M = 0.06  # of what is left of an object
BESIDE_M, BESIDE_PART = 0.04, 0.125  # what might be, also as a part of the distance across
GAP_M = 0.05  # between the coordinates or distances of what is named and the next
NARROW, WIDE = 0.12, 0.35  # distance from the line between two objects, relative to its length
MIDDLE, WHOLE = (0.2, 0.8), (-0.15, 1.15)  # parts of that line
LARGER = 1.2  # ratio of widths
MOST_MOVED = 3
THING = "object"

Fill = ObjectImage | str
Group = Sequence[Placement]


@dataclass(frozen=True, slots=True)
class Meaning:
    """A phrase with its slots filled.

    Args:
        fills: Slot to word or image.
        meant: What it refers to.
        num_required: How many of these are asked for; None: all.
    """

    fills: dict[str, Fill]
    meant: tuple[Placement, ...]
    num_required: int | None = None


@dataclass(frozen=True, slots=True)
class Things:
    """A table, as phrases see it.

    Args:
        candidates: Objects that a phrase may refer to: loose ones, or containers.
        loose: Objects that it may name by an image.
        absent: Objects that look like these and are not there.
        first: Whether the first of two alternatives is to apply.
    """

    candidates: Group
    loose: Group
    absent: Group
    first: bool

    def shapes(self) -> dict[str, Group]:
        """Candidates by shape."""
        return _grouped(self.candidates, lambda p: p.object)

    def textures(self) -> dict[str, Group]:
        """Candidates by texture."""
        return _grouped(self.candidates, lambda p: p.texture)

    def kinds(self) -> dict[str, Group]:
        """Candidates by noun: their shape, or "object" with or without a texture."""
        if self.candidates and self.candidates[0].fixed:
            return self.shapes()
        by_texture = {f"{texture} {THING}": group for texture, group in self.textures().items()}
        return {**self.shapes(), **by_texture, THING: self.candidates}


Find = Callable[[Things], Iterator[Meaning]]
Pick = Callable[[Group, Group], Placement | None]  # of candidates and named objects


def _grouped(group: Group, key: Callable[[Placement], str]) -> dict[str, Group]:
    return {name: [p for p in group if key(p) == name] for name in dict.fromkeys(map(key, group))}


def plural(noun: str) -> str:
    """Return the plural of a noun.

    Example:
        >>> [plural(noun) for noun in ("letter A", "red cross", "star")]
        ['letters A', 'red crosses', 'stars']
    """
    if "letter " in noun:
        return noun.replace("letter ", "letters ")
    return noun + ("es" if noun.endswith("s") else "s")


def _named(*placements: Placement) -> dict[str, Fill]:
    return {f"object_{n}": ObjectImage(placement) for n, placement in enumerate(placements, 1)}


# Relations


def _beside(direction: tuple[int, int]) -> Pick:
    def pick(candidates: Group, named: Group) -> Placement | None:
        offsets = {p.id: offset(p, named[0], direction) for p in candidates}
        wide = [p for p in candidates if offsets[p.id][0] > -max(BESIDE_M, BESIDE_PART * offsets[p.id][1])]
        narrow = [p for p in wide if offsets[p.id][0] > max(AHEAD_M, offsets[p.id][1])]
        return narrow[0] if narrow and len(wide) == 1 else None

    return pick


def _by_distance(sign: int) -> Pick:
    def pick(candidates: Group, named: Group) -> Placement | None:
        return _first_by(candidates, lambda p: sign * p.pose.planar_distance(named[0].pose))

    return pick


def _between(candidates: Group, named: Group) -> Placement | None:
    one, other = named
    line = (other.pose.x - one.pose.x, other.pose.y - one.pose.y)
    squared = math.hypot(*line) ** 2
    places = {p.id: [part / squared for part in offset(p, one, line)] for p in candidates}
    wide = [p for p in candidates if WHOLE[0] < places[p.id][0] < WHOLE[1] and places[p.id][1] < WIDE]
    narrow = [p for p in wide if MIDDLE[0] < places[p.id][0] < MIDDLE[1] and places[p.id][1] < NARROW]
    return narrow[0] if narrow and len(wide) == 1 else None


def _first_by(candidates: Group, key: Callable[[Placement], float], place: int = 0) -> Placement | None:
    """Return what comes at a place in an order, where gaps of the key part it from the next."""
    ordered = sorted(candidates, key=key)
    keys = [key(p) for p in ordered]
    gaps = [after - before for before, after in itertools.pairwise(keys)][: place + 1]
    return ordered[place] if len(gaps) > place and min(gaps) > GAP_M else None


def _related(pick: Pick, num_named: int = 1) -> Find:
    def find(things: Things) -> Iterator[Meaning]:
        for named in itertools.combinations(things.loose, num_named):
            for noun, group in things.kinds().items():
                others = [p for p in group if p not in named]
                meant = pick(others, named) if len(others) > 1 else None
                if meant:
                    yield Meaning({"noun": noun, **_named(*named)}, (meant,))

    return find


# Superlatives


def _extreme(key: Callable[[Placement], float], place: int = 0) -> Find:
    def find(things: Things) -> Iterator[Meaning]:
        for noun, group in things.kinds().items():
            if meant := _first_by(group, key, place):
                yield Meaning({"noun": noun}, (meant,))

    return find


def _of_size(sign: int) -> Find:
    def find(things: Things) -> Iterator[Meaning]:
        for noun, group in things.shapes().items():
            ordered = sorted(group, key=width_m, reverse=sign > 0)
            if len(ordered) > 1 and (width_m(ordered[0]) / width_m(ordered[1])) ** sign > LARGER:
                yield Meaning({"noun": noun}, (ordered[0],))

    return find


def width_m(placement: Placement) -> float:
    """Width of an object in metres, its scale included."""
    return placement.size[0] * placement.scale[0]


# Exceptions


def _all_but(num_named: int, noun_too: bool = False) -> Find:
    def find(things: Things) -> Iterator[Meaning]:
        for noun, group in things.kinds().items() if noun_too else ((None, things.candidates),):
            for named in itertools.combinations(group, num_named):
                meant = tuple(p for p in group if p not in named)
                if noun != THING and meant:
                    yield Meaning({**({"noun": noun} if noun else {}), **_named(*named)}, meant)

    return find


def _without(*slots: str) -> Find:
    """Return the meanings of a phrase whose slots are a noun, if any, and attributes that objects lack."""

    def find(things: Things) -> Iterator[Meaning]:
        values = {"shape": things.shapes(), "texture": things.textures()}
        nouns = {"shape": values["shape"], "texture": values["texture"], "": {"": things.candidates}}
        noun_slot, *lacked = slots
        for noun, group in nouns[noun_slot].items():
            for words in itertools.product(*(values[slot.split("_")[0]] for slot in lacked)):
                meant = tuple(p for p in group if not {p.object, p.texture} & set(words))
                excluded = [[p for p in group if word in (p.object, p.texture)] for word in words]
                if meant and all(excluded) and list(words) == sorted(set(words)):
                    fills: dict[str, Fill] = dict(zip(lacked, words, strict=True))
                    yield Meaning({**fills, **({noun_slot: noun} if noun_slot else {})}, meant)

    return find


def _single(find: Find) -> Find:
    return lambda things: (meaning for meaning in find(things) if len(meaning.meant) == 1)


def _several(find: Find) -> Find:
    return lambda things: (meaning for meaning in find(things) if len(meaning.meant) > 1)


# Numbers


def _some(num_there: Sequence[int], num_required: Callable[[int], int | None]) -> Find:
    """Return the meanings of a phrase about a kind of which so many are there; required None: all."""

    def find(things: Things) -> Iterator[Meaning]:
        for noun, group in things.kinds().items():
            if len(group) in num_there and noun != THING:
                yield Meaning({"nouns": plural(noun)}, tuple(group), num_required(len(group)))

    return find


def _as_many(things: Things) -> Iterator[Meaning]:
    shapes = things.shapes()
    for (noun, group), (other, counted) in itertools.permutations(shapes.items(), 2):
        if len(counted) < len(group):
            yield Meaning({"nouns": plural(noun), "others": plural(other)}, tuple(group), len(counted))


def _two_not(things: Things) -> Iterator[Meaning]:
    for meaning in _without("", "texture")(things):
        if len(meaning.meant) > 2:
            yield replace(meaning, num_required=2)


# Alternatives


def _or_if_none(things: Things) -> Iterator[Meaning]:
    for one in things.loose if things.first else things.absent:
        for other in things.loose:
            if other != one:
                yield Meaning(_named(one, other), (one if things.first else other,))


def _or_if_no_kind(things: Things) -> Iterator[Meaning]:
    textures = dict.fromkeys(p.texture for p in (*things.loose, *things.absent))  # in order, unlike a set
    for shape, texture in itertools.product(things.shapes(), textures):
        there = [p for p in things.loose if (p.object, p.texture) == (shape, texture)]
        for other in things.loose:
            if bool(there) == things.first and other not in there:
                meant = there[0] if there else other
                yield Meaning({"texture": texture, "shape": shape, **_named(other)}, (meant,))


def _if_more(things: Things) -> Iterator[Meaning]:
    for (noun, group), (other, counted) in itertools.permutations(things.shapes().items(), 2):
        if (len(group) > len(counted)) == things.first and len(group) != len(counted):
            for named in itertools.permutations(things.loose, 2):
                fills = {"nouns": plural(noun), "others": plural(other), **_named(*named)}
                yield Meaning(fills, (named[not things.first],))


def _if_beside(direction: tuple[int, int]) -> Find:
    def find(things: Things) -> Iterator[Meaning]:
        for named in itertools.permutations(things.loose, 3):
            ahead, across = offset(named[0], named[1], direction)
            is_clear = abs(ahead) > max(AHEAD_M, across)
            if is_clear and (ahead > 0) == things.first:
                yield Meaning(_named(*named), (named[0 if things.first else 2],))

    return find


LEFT, RIGHT, BEHIND, FRONT = (0, -1), (0, 1), (-1, 0), (1, 0)


@dataclass(frozen=True, slots=True)
class Phrase:
    """A phrase of the grammar.

    Args:
        text: Its words, with slots.
        find: All its clear meanings on a table.
        commands: Names of the commands that it may be part of.
        num_objects: Loose objects on the table, least and most.
    """

    text: str
    find: Find
    commands: tuple[str, ...] = ("put", "rotate")
    num_objects: tuple[int, int] = (5, 7)


ANY = ("put", "rotate", "into")
COMMANDS = {
    "put": "Put {PHRASE} into the {base}.",
    "rotate": "Rotate {PHRASE} {angle} degrees.",
    "into": "Put the {target} into {PHRASE}.",
}
PHRASES: dict[str, tuple[Phrase, ...]] = {
    "relation": (
        Phrase("the {noun} left of the {object_1}", _related(_beside(LEFT)), ANY),
        Phrase("the {noun} right of the {object_1}", _related(_beside(RIGHT)), ANY),
        Phrase("the {noun} in front of the {object_1}", _related(_beside(FRONT))),
        Phrase("the {noun} behind the {object_1}", _related(_beside(BEHIND))),
        Phrase("the {noun} nearest to the {object_1}", _related(_by_distance(1)), ANY),
        Phrase("the {noun} farthest from the {object_1}", _related(_by_distance(-1)), ANY),
        Phrase("the {noun} between the {object_1} and the {object_2}", _related(_between, 2)),
    ),
    "superlative": (
        Phrase("the leftmost {noun}", _extreme(lambda p: p.pose.y), ANY),
        Phrase("the rightmost {noun}", _extreme(lambda p: -p.pose.y), ANY),
        Phrase("the frontmost {noun}", _extreme(lambda p: -p.pose.x)),
        Phrase("the rearmost {noun}", _extreme(lambda p: p.pose.x)),
        Phrase("the second {noun} from the left", _extreme(lambda p: p.pose.y, 1)),
        Phrase("the second {noun} from the right", _extreme(lambda p: -p.pose.y, 1)),
        Phrase("the largest {noun}", _of_size(1)),
        Phrase("the smallest {noun}", _of_size(-1)),
    ),
    "exception": (
        Phrase("everything except the {object_1}", _all_but(1), ("put", "rotate"), (4, 4)),
        Phrase("everything except the {object_1} and the {object_2}", _all_but(2), ("put", "rotate"), (4, 5)),
        Phrase("every {noun} except the {object_1}", _several(_all_but(1, noun_too=True))),
        Phrase("every object that is not {texture}", _several(_without("", "texture"))),
        Phrase("every object that is not a {shape}", _several(_without("", "shape"))),
        Phrase("every {shape} that is not {texture}", _several(_without("shape", "texture"))),
        Phrase("the {shape} that is not {texture}", _single(_without("shape", "texture"))),
        Phrase("the {texture} object that is not a {shape}", _single(_without("texture", "shape"))),
        Phrase(
            "every object that is neither {texture_1} nor {texture_2}",
            _several(_without("", "texture_1", "texture_2")),
        ),
        Phrase(
            "the {shape} that is neither {texture_1} nor {texture_2}",
            _single(_without("shape", "texture_1", "texture_2")),
        ),
    ),
    "number": (
        Phrase("exactly one of the {nouns}", _some((2, 3), lambda _: 1)),
        Phrase("exactly two of the {nouns}", _some((3,), lambda _: 2)),
        Phrase("all but one of the {nouns}", _some((3,), lambda n: n - 1)),
        Phrase("both {nouns}", _some((2,), lambda _: None)),
        Phrase("all three {nouns}", _some((3,), lambda _: None)),
        Phrase("as many {nouns} as there are {others}", _as_many),
        Phrase("exactly two objects that are not {texture}", _two_not),
    ),
    "alternative": (
        Phrase("the {object_1}, or if there is none, the {object_2}", _or_if_none),
        Phrase("the {object_1} if there is one, and otherwise the {object_2}", _or_if_none),
        Phrase(
            "the {texture} {shape}, or if there is no {texture} {shape}, the {object_1}",
            _or_if_no_kind,
        ),
        Phrase(
            "the {object_1} if there are more {nouns} than {others}, and otherwise the {object_2}", _if_more
        ),
        Phrase(
            "the {object_1} if it is left of the {object_2}, and otherwise the {object_3}", _if_beside(LEFT)
        ),
        Phrase(
            "the {object_1} if it is right of the {object_2}, and otherwise the {object_3}", _if_beside(RIGHT)
        ),
    ),
}
"""Phrases of each task; with their commands they are the templates of its sentences."""


def templates(kind: str) -> tuple[tuple[str, Phrase], ...]:
    """Return the name of the command and the phrase of each template of a kind."""
    return tuple((command, phrase) for phrase in PHRASES[kind] for command in phrase.commands)


def sentence(command: str, phrase: Phrase) -> str:
    """Return a template with its slots."""
    return COMMANDS[command].replace("{PHRASE}", phrase.text)


def are_distinct(textures: Sequence[str]) -> bool:
    """Whether no texture is a part of another's name, so that "not red" is clear beside a red swirl.

    Example:
        >>> are_distinct(("red", "red swirl")), are_distinct(("red", "blue swirl"))
        (False, True)
    """
    words = [set(TEXTURES[name].name.split()) for name in textures]
    return not any(one < other for one, other in itertools.permutations(words, 2))
