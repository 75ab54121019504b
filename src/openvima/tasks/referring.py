"""Referring expressions, level L7: sentences of a grammar that training has no words for.

Scene:    four to seven objects of three shapes, three textures and three sizes, no two alike; a container
          where something goes into one, and two of one shape where the sentence chooses between them.
Prompt:   "Put the star left of the {object_1} into the {base}.", "Rotate everything except the {object_1} 30
          degrees." The templates are in `referring_grammar.py`.
Success:  what the sentence means is in its container, or rotated in place, within the tolerances of
          `visual_manipulation`, `sort_by_texture` and `rotate`; any other object there is a failure.
Source:   level L7 of openvima; not in the VIMA paper.
"""

import itertools
from dataclasses import replace

from openvima.catalog.objects import NO_SYMMETRY, object_spec
from openvima.errors import SamplingError
from openvima.scene import AtPose, DistractorsApart, ObjectImage, Placement, Problem, Prompt, Tolerance
from openvima.tasks.placing import ANGLES_DEG, TOLERANCE, rotation_goal
from openvima.tasks.referring_grammar import (
    MOST_MOVED,
    PHRASES,
    Things,
    are_distinct,
    sentence,
    templates,
)
from openvima.tasks.registry import register_task
from openvima.tasks.table import TableSampler

NUM_SHAPES = NUM_TEXTURES = 3
SCALES = (0.6, 0.78, 1.0)
SEVERAL = Tolerance(position_m=0.125)  # as where objects are sorted into one container
SUMMARIES = {
    "relation": "the object left of another, nearest to it, between two others.",
    "superlative": "the leftmost object, the second from the right, the largest.",
    "exception": "everything except one object, what is not red.",
    "number": "exactly two of the rings, as many stars as there are hearts.",
    "alternative": "an object, or if there is none, another; the one or the other as a condition says.",
}
_APART_M = 0.13
_TRIES = 30
_SPARE_STEPS = 2


def referring_problem(table: TableSampler, kind: str) -> Problem:
    """Set a table, and draw a sentence of a kind whose meaning is clear there.

    Raises:
        SamplingError: An object found no place, or no sentence is clear.
    """
    command, phrase = table.choose(templates(kind))
    least, most = phrase.num_objects

    bases = _place_bases(table, {"put": 1, "rotate": 0, "into": 2}[command])
    loose, absent = _place_objects(table, bases, int(table.rng.integers(least, most + 1)), command)
    things = Things(bases if command == "into" else loose, loose, absent, first=bool(table.rng.integers(2)))
    meanings = [m for m in phrase.find(things) if (m.num_required or len(m.meant)) <= MOST_MOVED]
    if not meanings:
        raise SamplingError(f"no filling of {phrase.text!r} is clear.")
    meaning = table.choose(meanings)
    fills: dict[str, ObjectImage | str | int] = {**meaning.fills}
    moved, base = meaning.meant, bases[0] if bases else None
    if command == "into":
        named = [fill.placement for fill in fills.values() if isinstance(fill, ObjectImage)]
        target = table.choose([p for p in loose if p not in named])
        fills["target"], moved, base = ObjectImage(target), (target,), meaning.meant[0]
    if base:
        if command == "put":
            fills["base"] = ObjectImage(base)
        tolerance = TOLERANCE if len(moved) == 1 else SEVERAL
        goals = [AtPose.into(p, base, tolerance) for p in moved]
    else:
        fills["angle"] = angle_deg = table.choose(ANGLES_DEG)
        goals = [rotation_goal(p, angle_deg, position_m=TOLERANCE.position_m) for p in moved]
    others = [p for p in table.placements if p not in moved and p is not base]
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(sentence(command, phrase), **fills),
        goals=tuple(goals),
        constraints=(DistractorsApart.of(others),),
        num_required=meaning.num_required,
        oracle_max_steps=(meaning.num_required or len(moved)) + _SPARE_STEPS,
    )


def _place_bases(table: TableSampler, count: int) -> list[Placement]:
    """Place containers of one shape and different textures."""
    shape = table.choose(table.pool.base_objects)
    textures = table.distinct(table.pool.base_textures, count)
    return [
        table.place_one("base", lambda texture=texture: (shape, texture), tries=_TRIES)
        for texture in textures
    ]


def _place_objects(
    table: TableSampler, bases: list[Placement], count: int, command: str
) -> tuple[list[Placement], list[Placement]]:
    """Place objects of few shapes and textures, no two alike; return them and those that are not there."""
    pool = table.pool
    shapes = [s for s in pool.dragged_objects if object_spec(s).symmetry_rad == NO_SYMMETRY]
    shapes = table.shuffled(shapes if command == "rotate" else pool.dragged_objects)[:NUM_SHAPES]
    textures = table.shuffled(pool.dragged_textures)[:NUM_TEXTURES]
    if not are_distinct((*textures, *(base.texture for base in bases))):
        raise SamplingError(f"{', '.join(textures)} are not clearly distinct.")
    chosen = table.shuffled(list(itertools.product(shapes, textures)))
    placed: list[Placement] = []
    while len(placed) < count:
        scale = table.choose(SCALES)
        placed.append(
            table.place_one(
                "object",
                lambda: chosen[len(placed)],
                tries=_TRIES,
                scale=(scale, scale, scale),
                apart_m=_APART_M,
            )
        )
    absent = [replace(placed[0], id=0, object=shape, texture=texture) for shape, texture in chosen[count:]]
    return placed, absent


def _register(kind: str) -> None:
    command, phrase = templates(kind)[0]

    @register_task(
        f"refer_by_{kind}",
        family="referring_expression",
        template=sentence(command, phrase),
        oracle_max_steps=MOST_MOVED + _SPARE_STEPS,
        summary=SUMMARIES[kind],
    )
    def sample(table: TableSampler) -> Problem:
        """Sample one problem."""
        return referring_problem(table, kind)


for _kind in PHRASES:
    _register(_kind)
