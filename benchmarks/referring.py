"""Whether sentences of level L7 have one reading, and how often scenes are drawn again until they have.

    python benchmarks/referring.py [--episodes N] [--seed S] [--json FILE]

The resolver gets the text form of a prompt and the scene's objects: name, texture, size and pose. It knows
the catalogue and English, nothing of the grammar, of roles and of goals: it takes a sentence apart and looks
for what fits a strict and a lenient reading of its words. Where the two differ, the sentence is ambiguous.
N sentences of each task, from seed S of domain "eval".
"""

import argparse
import collections
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from openvima.catalog import OBJECTS, TEXTURES
from openvima.catalog.partitions import tasks_at
from openvima.errors import SamplingError
from openvima.scene import AtPose, Episode, Placement, Scene
from openvima.tasks import sample_episode
from sim import circumstances

CONTAINERS = ("bowl", "pan", "frame", "square", "container", "pallet")
CONE_DEG, HALF_DEG = 46.0, 95.0  # strict and lenient width of a direction, on each side
CLEAR_M = 0.03  # by which an order or a distance is clear
CLEAR_RATIO = 1.1  # of areas
DETOUR, LENIENT_DETOUR = 0.1, 0.15  # of a way through an object that is "between" two others
NUMBERS = {"one": 1, "two": 2, "three": 3}
Objects = list[Placement]


class AmbiguousError(ValueError):
    """The sentence has no reading, or more than one."""


@dataclass(frozen=True, slots=True)
class Reading:
    """What a sentence asks for.

    Args:
        objects: Ids of what to move.
        number: How many of them.
        container: Id of where to put them; None to rotate them.
        angle_deg: By how much.
    """

    objects: frozenset[int]
    number: int
    container: int | None = None
    angle_deg: int | None = None


def read(text: str, scene: Scene) -> Reading:
    """Read a sentence.

    Raises:
        AmbiguousError: It is no sentence, or its words do not decide.
    """
    loose = [p for p in scene.placements if p.object not in CONTAINERS]
    containers = [p for p in scene.placements if p.object in CONTAINERS]
    if found := re.fullmatch(r"Rotate (.+) (\d+) degrees\.", text):
        objects, number = refer(found[1], loose, loose)
        return Reading(frozenset(p.id for p in objects), number, angle_deg=int(found[2]))
    if found := re.fullmatch(r"Put (.+) into (.+)\.", text):
        objects, number = refer(found[1], loose, loose)
        into, _ = refer(found[2], containers, loose)
        return Reading(frozenset(p.id for p in objects), number, container=_only(into).id)
    raise AmbiguousError(f"{text!r} is neither to put nor to rotate something.")


def refer(phrase: str, candidates: Objects, loose: Objects) -> tuple[Objects, int]:
    """Return what a phrase refers to, and how many of these are asked for."""
    for pattern, resolve in RULES:
        if found := re.fullmatch(pattern, phrase):
            result = resolve(candidates, loose, *found.groups())
            objects, number = result if isinstance(result, tuple) else (result, len(result))
            if not 0 < number <= len(objects):
                raise AmbiguousError(f"{phrase!r} asks for {number} of {len(objects)} objects.")
            return objects, number
    raise AmbiguousError(f"{phrase!r} is no phrase.")


def such(noun: str, group: Objects) -> Objects:
    """Return the objects of a group that a noun with or without a texture describes, singular or plural."""
    noun = re.sub(r"^(.*?)letters (\w)$", r"\1letter \2", noun)
    forms = (noun, noun.removesuffix("s"), noun.removesuffix("es"))
    found = [
        p for p in group if {p.object, f"{p.texture} {p.object}", f"{p.texture} object", "object"} & {*forms}
    ]
    words = {*TEXTURES, *OBJECTS, "object"}
    if not any(form == word or form.endswith(f" {word}") for form in forms for word in words):
        raise AmbiguousError(f"nothing is called {noun!r}.")
    return found


def _only(group: Objects) -> Placement:
    if len(group) != 1:
        raise AmbiguousError(f"{len(group)} objects instead of one.")
    return group[0]


def _one(noun: str, group: Objects) -> Placement:
    """Return the one object that a description fits."""
    return _only(such(noun, group))


def _agreed(strict: Objects, lenient: Objects) -> Objects:
    if strict != lenient:
        raise AmbiguousError(f"{len(strict)} objects fit strictly, {len(lenient)} leniently.")
    return [_only(strict)]


def _picture(p: Placement) -> tuple[float, float]:
    """Return metres to the right and up in the top view."""
    return p.pose.y, -p.pose.x


BEARINGS_DEG = {"left of": 180, "right of": 0, "in front of": 270, "behind": 90}


def _bearing_error_deg(p: Placement, landmark: Placement, relation: str) -> float:
    (right, up), (right_0, up_0) = _picture(p), _picture(landmark)
    bearing = math.degrees(math.atan2(up - up_0, right - right_0))
    return abs((bearing - BEARINGS_DEG[relation] + 180) % 360 - 180)


def beside(candidates: Objects, loose: Objects, noun: str, relation: str, landmark: str) -> Objects:
    """Resolve "the star left of the red heart"."""
    there = _one(landmark, loose)
    group = [p for p in such(noun, candidates) if p is not there]
    errors = [(p, _bearing_error_deg(p, there, relation)) for p in group]
    return _agreed([p for p, e in errors if e < CONE_DEG], [p for p, e in errors if e < HALF_DEG])


def by_distance(candidates: Objects, loose: Objects, noun: str, how: str, landmark: str) -> Objects:
    """Resolve "the star nearest to the red heart"."""
    there = _one(landmark, loose)
    group = [p for p in such(noun, candidates) if p is not there]
    return [_extreme(group, lambda p: math.dist(_picture(p), _picture(there)), last=how == "farthest from")]


def between(candidates: Objects, loose: Objects, noun: str, one: str, other: str) -> Objects:
    """Resolve "the star between the red heart and the blue ring"."""
    ends = [_one(one, loose), _one(other, loose)]
    (x0, y0), (x1, y1) = map(_picture, ends)
    length = math.hypot(x1 - x0, y1 - y0)

    def detour(p: Placement) -> float:
        return sum(math.dist(_picture(p), _picture(end)) for end in ends) / length - 1

    group = [p for p in such(noun, candidates) if p not in ends]
    return _agreed([p for p in group if detour(p) < DETOUR], [p for p in group if detour(p) < LENIENT_DETOUR])


def _extreme(group: Objects, key: Callable[[Placement], float], *, last: bool, place: int = 0) -> Placement:
    order = sorted(group, key=key, reverse=last)
    if len(order) < place + 2:
        raise AmbiguousError(f"there are {len(order)} objects to compare.")
    near = [p for p in order if abs(key(p) - key(order[place])) < CLEAR_M]
    return _only(near)


SIDES: dict[str, tuple[int, bool]] = {  # axis of the picture, and whether the last along it
    "leftmost": (0, False),
    "rightmost": (0, True),
    "frontmost": (1, False),
    "rearmost": (1, True),
}


def at_side(candidates: Objects, loose: Objects, side: str, noun: str) -> Objects:
    """Resolve "the leftmost star"."""
    axis, last = SIDES[side]
    return [_extreme(such(noun, candidates), lambda p: _picture(p)[axis], last=last)]


def second(candidates: Objects, loose: Objects, noun: str, side: str) -> Objects:
    """Resolve "the second star from the left"."""
    group = such(noun, candidates)
    return [_extreme(group, lambda p: _picture(p)[0], last=side == "right", place=1)]


def by_size(candidates: Objects, loose: Objects, how: str, noun: str) -> Objects:
    """Resolve "the largest star"."""
    areas = [(p.size[0] * p.scale[0] * p.size[1] * p.scale[1], p) for p in such(noun, candidates)]
    areas.sort(key=lambda pair: pair[0], reverse=how == "largest")
    if len(areas) < 2 or max(areas[0][0], areas[1][0]) < CLEAR_RATIO * min(areas[0][0], areas[1][0]):
        raise AmbiguousError(f"no {noun!r} is clearly the {how}.")
    return [areas[0][1]]


def all_but(candidates: Objects, loose: Objects, noun: str, *exceptions: str | None) -> Objects:
    """Resolve "everything except the red heart", "every star except the red star"."""
    out = [_one(name, candidates) for name in exceptions if name]
    group = candidates if noun == "thing" else such(noun, candidates)
    if not all(p in group for p in out):
        raise AmbiguousError(f"an exception is no {noun!r}.")
    return [p for p in group if p not in out]


def lacking(candidates: Objects, loose: Objects, how: str, noun: str, words: str) -> Objects:
    """Resolve "every object that is not red", "the star that is neither red nor blue"."""
    group = such(noun, candidates)
    attributes = [re.sub("^an? ", "", word) for word in re.split(" nor ", words)]
    for word in attributes:
        if not any(word in (p.texture, p.object) for p in group):
            raise AmbiguousError(f"nothing there is {word!r}.")
        if any(word in p.texture.split() and word != p.texture for p in candidates):
            raise AmbiguousError(f"something is partly {word!r}.")
    rest = [p for p in group if p.texture not in attributes and p.object not in attributes]
    return [_only(rest)] if how == "the" else rest


def some(candidates: Objects, loose: Objects, number: str, noun: str) -> tuple[Objects, int]:
    """Resolve "exactly two of the stars"."""
    group = such(noun, candidates)
    asked = {"all but one": len(group) - 1}.get(number) or NUMBERS[number.removeprefix("exactly ")]
    if asked >= len(group):
        raise AmbiguousError(f"there are only {len(group)} of {noun!r}.")
    return group, asked


def all_of(candidates: Objects, loose: Objects, number: str, noun: str) -> Objects:
    """Resolve "both stars", "all three red objects"."""
    group = such(noun, candidates)
    if len(group) != {"both": 2, "all three": 3}[number]:
        raise AmbiguousError(f"there are {len(group)} of {noun!r}.")
    return group


def as_many(candidates: Objects, loose: Objects, noun: str, other: str) -> tuple[Objects, int]:
    """Resolve "as many stars as there are hearts"."""
    return such(noun, candidates), len(such(other, candidates))


def some_lacking(candidates: Objects, loose: Objects, number: str, texture: str) -> tuple[Objects, int]:
    """Resolve "exactly two objects that are not red"."""
    return lacking(candidates, loose, "every", "object", texture), NUMBERS[number]


def if_there(candidates: Objects, loose: Objects, one: str, other: str) -> Objects:
    """Resolve "the red heart, or if there is none, the blue star"."""
    return [_only(such(one, loose) or such(other, loose))]


def if_there_by_name(candidates: Objects, loose: Objects, one: str, same: str, other: str) -> Objects:
    """Resolve "the red heart, or if there is no red heart, the blue star"."""
    if one != same:
        raise AmbiguousError(f"{one!r} and {same!r} differ.")
    return if_there(candidates, loose, one, other)


def if_more(candidates: Objects, loose: Objects, one: str, many: str, few: str, other: str) -> Objects:
    """Resolve "the red heart if there are more stars than rings, and otherwise the blue star"."""
    numbers = len(such(many, loose)), len(such(few, loose))
    if numbers[0] == numbers[1]:
        raise AmbiguousError(f"there are as many {many!r} as {few!r}.")
    return [_one(one if numbers[0] > numbers[1] else other, loose)]


def if_beside(
    candidates: Objects, loose: Objects, one: str, relation: str, landmark: str, other: str
) -> Objects:
    """Resolve "the red heart if it is left of the ring, and otherwise the blue star"."""
    error = _bearing_error_deg(_one(one, loose), _one(landmark, loose), relation)
    if CONE_DEG < error < 180 - CONE_DEG:
        raise AmbiguousError(f"whether it is {relation} the other is not clear.")
    return [_one(one if error <= CONE_DEG else other, loose)]


_ASIDE = "(left of|right of)"
RULES: Sequence[tuple[str, Callable[..., Any]]] = (
    ("the (.+) if there are more (.+) than (.+), and otherwise the (.+)", if_more),
    (f"the (.+) if it is {_ASIDE} the (.+), and otherwise the (.+)", if_beside),
    ("the (.+) if there is one, and otherwise the (.+)", if_there),
    ("the (.+), or if there is none, the (.+)", if_there),
    ("the (.+), or if there is no (.+), the (.+)", if_there_by_name),
    ("the (.+) (left of|right of|in front of|behind) the (.+)", beside),
    ("the (.+) (nearest to|farthest from) the (.+)", by_distance),
    ("the (.+) between the (.+) and the (.+)", between),
    ("the second (.+) from the (left|right)", second),
    ("the (leftmost|rightmost|frontmost|rearmost) (.+)", at_side),
    ("the (largest|smallest) (.+)", by_size),
    ("every(thing) except the (.+?)(?: and the (.+))?", all_but),
    ("every (.+) except the (.+)", all_but),
    ("(every|the) (.+) that is (?:not|neither) (.+)", lacking),
    ("exactly (.+) objects that are not (.+)", some_lacking),
    ("(exactly one|exactly two|all but one) of the (.+)", some),
    ("(both|all three) (.+)", all_of),
    ("as many (.+) as there are (.+)", as_many),
    ("the (.+)", lambda candidates, loose, noun: [_one(noun, candidates)]),
)
"""What phrases look like, the longer before those that are part of them, and how they are resolved."""


def disagreement(episode: Episode) -> str:
    """Return how the resolver's reading differs from the goals; empty where they agree.

    Args:
        episode: Sampled with `prompts="text"`.
    """
    problem = episode.problem
    goals = [goal for goal in problem.goals if isinstance(goal, AtPose)]
    try:
        reading = read(problem.prompt.text, problem.scene)
    except AmbiguousError as error:
        return str(error)
    objects = frozenset(goal.object_id for goal in goals)
    number = problem.num_required or len(goals)
    (place,) = {goal.relative_to if goal.relative_to != goal.object_id else None for goal in goals}
    meant = Reading(objects, number, place, reading.angle_deg if place is None else None)
    if reading != meant:
        return f"read as {reading}, meant is {meant}."
    for goal in goals if reading.angle_deg else ():
        turn_deg = math.degrees(problem.scene[goal.object_id].pose.yaw_rad - goal.target.yaw_rad)
        if abs(math.remainder(turn_deg - (reading.angle_deg or 0), 360)) > 1e-6:
            return f"read as {reading}, meant are {turn_deg} degrees."
    return ""


def measure(task: str, seeds: Sequence[int]) -> dict[str, Any]:
    """Count sentences, disagreements, and scenes that were drawn again."""
    redraws, failed, sentences, differing = 0, 0, collections.Counter[str](), []
    for seed in seeds:
        try:
            episode = sample_episode(task, level="L7", seed=seed, domain="eval", prompts="text")
        except SamplingError:
            failed += 1
            continue
        redraws += episode.num_redraws
        sentences[episode.problem.prompt.text] += 1
        if why := disagreement(episode):
            differing.append(f"{task} {seed} {episode.problem.prompt.text} {why}")
    return {
        "task": task,
        "sentences": len(seeds) - failed,
        "distinct": len(sentences),
        "failed": failed,
        "redraws": redraws,
        "differing": differing,
    }


def main() -> None:
    """Measure and print a row for each task."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--episodes", type=int, default=2000, help="of each task")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="file to write")
    options = parser.parse_args()
    rows = []
    for task in tasks_at("L7"):
        row = measure(task, range(options.seed, options.seed + options.episodes))
        rows.append(row)
        again = row["redraws"] / (row["redraws"] + row["sentences"])
        counted = f"{row['sentences']} sentences, {row['distinct']} distinct, {row['failed']} not found"
        differing = f"{len(row['differing'])} read otherwise, {again:.1%} of scenes drawn again"
        print(f"{task:<22}{counted}, {differing}", flush=True)
        for line in row["differing"][:5]:
            print(f"  {line}")
    if options.json:
        record = {**circumstances(), "seed": options.seed, "rows": rows}
        options.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
