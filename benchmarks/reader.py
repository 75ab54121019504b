r"""A scripted reader of text prompts: a bound for policies that read perfectly, but see boxes only.

    openvima evaluate --policy reader=benchmarks/reader.py:reader --prompts text --levels L5,L6,L7,L8 \
        --episodes 100 --out reader

It is told the name and texture of each object, and sees its box in the top view and one pixel of it: no pose,
no size, nothing of goals and roles. It knows the sentences of the tasks; those of L7 are read by
`referring.py`, from the boxes. Of several objects that fit it takes the first. Images of scenes it cannot
read: then the episode fails as unreadable. When it has done everything, it does it again.
"""

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

from openvima.catalog import OBJECTS
from openvima.data.chat import UNREADABLE
from openvima.env import TabletopEnv
from openvima.errors import AnswerError
from openvima.perception.objects import observe
from openvima.scene import Action, Placement, Pose, Scene
from openvima.tasks.pushes import SHORTFALL_M, STANDOFF_M
from referring import CONTAINERS, AmbiguousError, read, such

DIRECTIONS = {"north": (-1, 0), "south": (1, 0), "west": (0, -1), "east": (0, 1)}  # signs of x and y
ASIDE_M = 0.17  # from a row to where an object is put aside
PIXEL_M = 0.004
NUMBERS = {"any": 1, "one": 1, "two": 2, "three": 3, "all": 99}
Point = tuple[float, float]
Moves = Iterator[Action]


def reader() -> "Reader":
    """Make the reader."""
    return Reader()


class Reader:
    """Reads the prompts of a batch of episodes, and follows them."""

    def begin(self, envs: Sequence[TabletopEnv]) -> None:
        """Start a batch of episodes."""
        self._tables = [Table(env) for env in envs]
        pairs = zip(envs, self._tables, strict=True)
        self._moves = [_follow(env.episode.problem.prompt.text, table) for env, table in pairs]

    def decide(self, observations: Sequence[Mapping | None]) -> list[Action | AnswerError | None]:
        """Make the next move of each episode that runs."""
        episodes = zip(self._tables, self._moves, observations, strict=True)
        return [None if seen is None else _next(table, moves, seen) for table, moves, seen in episodes]


def _next(table: "Table", moves: Moves, seen: Mapping) -> Action | AnswerError:
    table.look(seen)
    try:
        return next(moves)
    except (AmbiguousError, StopIteration) as error:
        return AnswerError(UNREADABLE, str(error).rstrip(".") or "there is no sentence")


class Table:
    """What is seen of a table now, and was at first; words that the prompt defines."""

    def __init__(self, env: TabletopEnv) -> None:
        self._named = env.scene
        self.seen: dict[int, Placement] = {}
        self.grasps: dict[int, Point] = {}
        self.first: dict[int, Placement] = {}
        self.words: dict[str, str] = {}
        self.is_dark: dict[str, bool | None] = {}  # None: the word is not about that

    def look(self, observation: Mapping) -> None:
        """Take boxes and pixels from an observation."""
        views = observe(observation)
        boxes = zip(views.ids.tolist(), views.positions().tolist(), views.boxes[1].tolist(), strict=True)
        for object_id, (x, y), (_, _, height, width) in boxes:
            size = (height * PIXEL_M, width * PIXEL_M, 0.0)
            self.seen[object_id] = replace(
                self._named[object_id], size=size, scale=(1.0, 1.0, 1.0), pose=Pose.planar(x, y), fixed=False
            )
        self.grasps |= zip(views.ids.tolist(), map(tuple, views.grasp_points().tolist()), strict=True)
        self.first = self.first or dict(self.seen)

    def find(self, phrase: str) -> list[int]:
        """Return the objects that a phrase fits.

        Raises:
            AmbiguousError: There is none.
        """
        noun = re.sub(r"^(the|an?|each|all) (same )?", "", phrase)
        group = [*self.seen.values()]
        for word, is_dark in self.is_dark.items():
            if found := re.fullmatch(rf"(less )?{word} (.+)", noun):
                noun = found[2]
                if is_dark is not None:
                    group = [p for p in group if _is_dark(p.texture) == (is_dark != bool(found[1]))]
        noun = self.words.get(noun, noun)
        if not (fitting := [p.id for p in such(noun, group)]):
            raise AmbiguousError(f"there is no {noun!r}.")
        return fitting

    def move(self, object_id: int, to: Point, turn_deg: float = 0.0) -> Action:
        """Bring the middle of an object's box to a point, or turn the object in place."""
        x, y = self.grasps[object_id]
        pose = self.seen[object_id].pose
        place = (x, y) if turn_deg else (to[0] + x - pose.x, to[1] + y - pose.y)
        return Action.planar((x, y), place, -math.radians(turn_deg))

    def at(self, object_id: int) -> Point:
        """Return the middle of an object's box."""
        return self.seen[object_id].pose.x, self.seen[object_id].pose.y

    def was_at(self, object_id: int) -> Point:
        """Return the same of the first observation."""
        return self.first[object_id].pose.x, self.first[object_id].pose.y


def _is_dark(texture: str) -> bool:
    return texture.startswith("dark ")


def _follow(text: str, table: Table) -> Moves:
    """Follow a prompt, again and again."""
    while True:
        if re.search(r"^(Put|Rotate) (?!all objects with).*\.$", text) and ". " not in text:
            try:
                yield from _refer(text, table)
                continue
            except AmbiguousError:  # no sentence of L7, or one of several objects
                pass
        it: list[int] = []
        for sentence in re.split(r"(?<=\.) ", text):
            yield from _obey(re.sub("^(Then |First )", "", sentence).rstrip("."), table, it)


def _refer(text: str, table: Table) -> Moves:
    """Do what a sentence of L7 says."""
    meant = read(text, Scene(tuple(sorted(table.seen.values(), key=lambda p: p.id))))
    for object_id in sorted(meant.objects)[: meant.number]:
        if meant.container is None:
            yield table.move(object_id, (0, 0), meant.angle_deg or 0)
        else:
            yield table.move(object_id, table.at(meant.container))


def _obey(sentence: str, table: Table, it: list[int]) -> Moves:
    for pattern, obey in RULES:
        if found := re.fullmatch(pattern, sentence, re.IGNORECASE):
            yield from obey(table, it, *found.groups())
            return
    raise AmbiguousError(f"{sentence!r} is no sentence.")


def _define(table: Table, it: list[int], word: str, name: str) -> Moves:
    """Obey "This is a wug: a heart"."""
    table.words[word] = name
    yield from ()


def _compare(table: Table, it: list[int], one: str, word: str, other: str) -> Moves:
    """Obey "The dark red star is daxer than the red star"."""
    table.is_dark.setdefault(word, None)
    if _is_dark(one) != _is_dark(other):
        table.is_dark[word] = _is_dark(one)
    yield from ()


def _put(table: Table, it: list[int], what: str, into: str) -> Moves:
    """Obey "put the red star into the blue pan", "put it into the blue pan"."""
    it[:] = it if what == "it" else table.find(what)[:1]
    yield table.move(it[0], table.at(table.find(into)[0]))


def _put_in_turn(table: Table, it: list[int], what: str, into: str) -> Moves:
    """Obey "put the star into the pan then the bowl"."""
    for base in into.split(" then "):
        yield from _put(table, it, what, base)


def _put_two(table: Table, it: list[int], what: str, into: str, direction: str) -> Moves:
    """Obey "put the star into the pan then put the object that was previously at its south into it"."""
    yield from _put(table, it, what, into)
    yield from _put_neighbor(table, it, direction, into)


def _put_neighbor(table: Table, it: list[int], direction: str, into: str) -> Moves:
    x, y = table.was_at(it[0])
    ux, uy = DIRECTIONS[direction]

    def offset(object_id: int) -> Point:
        dx, dy = table.was_at(object_id)[0] - x, table.was_at(object_id)[1] - y
        return ux * dx + uy * dy, abs(uy * dx + ux * dy)

    ahead = {i: offset(i) for i in table.first if offset(i)[1] < offset(i)[0]}
    if not ahead:
        raise AmbiguousError(f"there is nothing at its {direction}.")
    nearest = min(ahead, key=lambda i: ahead[i][0] + 2 * ahead[i][1])
    yield table.move(nearest, table.at(table.find(into)[0]))


def _gather(table: Table, it: list[int], what: str, base: str) -> Moves:
    """Obey "put all objects with the same texture as the red bowl into it"."""
    (container, *_) = table.find(base)
    like = table.seen[container]

    def is_alike(p: Placement) -> bool:
        if what == "texture":
            return p.texture == like.texture
        return OBJECTS[p.object].profile == OBJECTS[like.object].profile

    for p in [p for p in table.first.values() if p.object not in CONTAINERS and is_alike(p)]:
        yield table.move(p.id, table.at(container))


def _sort(table: Table, it: list[int], text: str) -> Moves:
    """Obey "put each ring into the pan, each star into the bowl and each heart into the square"."""
    for what, into in re.findall(r"(?:each|all) (.+?) into (.+?)(?:, | and (?=each|all)|$)", text):
        for object_id in [i for i in table.find(what) if table.seen[i].object not in CONTAINERS]:
            yield table.move(object_id, table.at(table.find(into)[0]))


def _restore(table: Table, it: list[int], *_: str) -> Moves:
    """Obey "restore it"."""
    yield table.move(it[0], table.was_at(it[0]))


def _rotate(table: Table, it: list[int], what: str, degrees: str) -> Moves:
    """Obey "rotate the red star 60 degrees"."""
    it[:] = it if what == "it" else table.find(what)[:1]
    yield table.move(it[0], (0, 0), int(degrees))


def _reverse(table: Table, it: list[int], text: str) -> Moves:
    """Obey "reverse the order of the red star the blue ring …", by way of the free side of the row."""
    row = [table.find(name)[0] for name in text.removeprefix("the ").split(" the ")]
    others = [table.was_at(i) for i in table.first if i not in row]
    x = table.was_at(row[0])[0]
    side = -1 if any(other[0] > x for other in others) else 1
    for one, other in list(zip(row, reversed(row), strict=True))[: len(row) // 2]:
        (_, y), place = table.was_at(one), table.was_at(other)
        yield table.move(one, (x + side * ASIDE_M, y))
        yield table.move(other, table.was_at(one))
        yield table.move(one, place)


def _sweep(table: Table, it: list[int], number: str, what: str, into: str, line: str) -> Moves:
    """Obey "sweep two red blocks into the red rectangle without exceeding the blue line"."""
    area, limit = table.find(into)[0], table.find(line)[0]
    mouth = table.at(area)[0] + table.seen[area].size[0] / 2
    end = (table.at(limit)[0] + mouth) / 2, table.at(area)[1]
    for block in sorted(table.find(what), key=lambda i: math.dist(table.at(i), end))[: NUMBERS[number]]:
        x, y = table.at(block)
        way = math.dist((x, y), end)
        ux, uy = (end[0] - x) / way, (end[1] - y) / way
        start = x - STANDOFF_M * ux, y - STANDOFF_M * uy
        yield Action.planar(start, (end[0] + SHORTFALL_M * ux, end[1] + SHORTFALL_M * uy))


RULES: Sequence[tuple[str, Callable[..., Moves]]] = (
    (r"This is an? (\w+): an? (.+)", _define),
    (r"The (.+) is (\w+) than the (.+)", _compare),
    (
        "Put (the .+) into (.+) then put the object that was previously at its (.+?) into the same .+",
        _put_two,
    ),
    ("Put the object that was previously at its (.+?) into (.+)", _put_neighbor),
    ("Put all objects with the same (texture|profile) as (.+) into it", _gather),
    ("Put ((?:each|all) .+)", _sort),
    ("Put (.+?) into (.+ then .+)", _put_in_turn),
    ("Put (.+?) into (.+)", _put),
    ("(?:Finally )?restore it(?: into its original container)?", _restore),
    (r"Rotate (.+) (\d+) degrees", _rotate),
    ("Reverse the order of (.+)", _reverse),
    ("Sweep (any|one|two|three|all) (.+) into (.+) without exceeding (.+)", _sweep),
)
"""Sentences, the longer before those that are part of them, and how they are obeyed."""
