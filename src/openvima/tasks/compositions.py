"""Compositions, level L6: two or three instructions of trained tasks in one prompt, on one table.

Scene:    the objects of all instructions, and distractors that share a shape or a texture with one of them.
Prompt:   "Rotate the {object_1} 60 degrees. Then put the {object_2} into the {base_2}." Each part is worded
          as in training; an instruction may refer to an earlier one ("Then put it into the {base_2}.") or to
          a definition ("This is a wug {object_1}. Rotate the wug 30 degrees.").
Success:  each instruction as in its task, in the order of the prompt, while no distractor is within reach of
          a target or of an object to move.
Source:   level L6 of openvima; not in the VIMA paper.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

from openvima.catalog.objects import NO_SYMMETRY, object_spec
from openvima.errors import SamplingError
from openvima.scene import (
    AtPose,
    DistractorsApart,
    InOrder,
    ObjectImage,
    Placement,
    Problem,
    Prompt,
    SceneImage,
    Tolerance,
)
from openvima.tasks.manipulate_old_neighbor import NEIGHBOURS
from openvima.tasks.novel_words import NOUNS, gray_image
from openvima.tasks.options import FewDistractors
from openvima.tasks.placing import ANGLES_DEG, rotation_goal
from openvima.tasks.registry import register_task
from openvima.tasks.table import Appearance, TableSampler, is_in_the_way, offset

COMPOSITIONS: dict[str, tuple[str, ...]] = {
    "put_then_put": ("put", "put"),
    "put_then_rotate": ("put", "rotate"),
    "rotate_then_put": ("rotate", "put"),
    "rotate_then_rotate": ("rotate", "rotate"),
    "gather_then_rotate": ("gather", "rotate"),
    "gather_then_put": ("gather", "put"),
    "rearrange_then_put": ("rearrange", "put"),
    "rotate_then_put_it": ("rotate", "put_it"),
    "put_then_put_it": ("put", "put_it"),
    "put_then_restore": ("put", "restore"),
    "put_then_neighbor": ("put", "neighbor"),
    "define_then_rotate_and_put": ("define", "rotate_defined", "put"),
    "define_then_put_and_rotate": ("define", "put_defined", "rotate"),
    "rotate_put_it_restore": ("rotate", "put_it", "restore"),
    "put_rotate_put": ("put", "rotate", "put"),
    "put_neighbor_rotate": ("put", "neighbor", "rotate"),
    "gather_rotate_put_it": ("gather", "rotate", "put_it"),
    "define_rotate_put_it_restore": ("define", "rotate_defined", "put_it", "restore"),
}
"""Thirteen pairs and five triples; a definition counts as no instruction."""

TOLERANCE = Tolerance(position_m=0.1)
APART_M = 0.12
_NEIGHBOR_M = 0.17
_TRIES = 30
_SPARE_STEPS = 1


@dataclass(slots=True)
class Composition:
    """What the instructions so far have put on the table.

    Args:
        table: Sampler of the scene.
        fills: Slots of the prompt.
        object: The object that "it" refers to.
        base: The last base.
        appearances: Appearances that no other object may have.
        shapes, textures: Shapes that a definition means, and textures that an instruction gathers.
        places: Where objects are to go on the free table.
        directions: Object, step and neighbour that nothing may come between.
    """

    table: TableSampler
    fills: dict[str, ObjectImage | SceneImage | str | int] = field(default_factory=dict)
    object: Placement | None = None
    base: Placement | None = None
    appearances: set[Appearance] = field(default_factory=set)
    shapes: set[str] = field(default_factory=set)
    textures: set[str] = field(default_factory=set)
    places: list[Placement] = field(default_factory=list)
    directions: list[tuple[Placement, tuple[int, int], Placement]] = field(default_factory=list)

    def put(self, shapes: tuple[str, ...], textures: tuple[str, ...], what: str = "object") -> Placement:
        """Place an object that no instruction so far means."""

        def draw() -> Appearance:
            for _ in range(_TRIES):
                shape, texture = self.table.choose(shapes), self.table.choose(textures)
                is_meant = shape in self.shapes or texture in self.textures
                if not is_meant and (shape, texture) not in self.appearances:
                    return shape, texture
            raise SamplingError(f"no appearance is left for the {what}.")

        new = self.table.place_one(what, draw, tries=_TRIES, apart_m=APART_M, reject=self._reaches_a_place)
        self.appearances.add((new.object, new.texture))
        return new

    def new_object(self, *, asymmetric: bool = False) -> Placement:
        """Place an object to move."""
        pool = self.table.pool
        shapes = [s for s in pool.dragged_objects if object_spec(s).symmetry_rad == NO_SYMMETRY]
        self.object = self.put(tuple(shapes) if asymmetric else pool.dragged_objects, pool.dragged_textures)
        return self.object

    def new_base(self) -> Placement:
        """Place a base."""
        self.base = self.put(self.table.pool.base_objects, self.table.pool.base_textures, "base")
        return self.base

    def _reaches_a_place(self, new: Placement) -> bool:
        return any(is_in_the_way(new, place, APART_M) for place in self.places)


Goals = tuple[AtPose, ...]


def _into(placement: Placement, base: Placement) -> Goals:
    return (AtPose.into(placement, base, TOLERANCE),)


def _put(made: Composition, n: int) -> Goals:
    target, base = made.new_object(), made.new_base()
    made.fills |= {f"object_{n}": ObjectImage(target), f"base_{n}": ObjectImage(base)}
    return _into(target, base)


def _put_it(made: Composition, n: int) -> Goals:
    assert made.object
    base = made.new_base()
    made.fills[f"base_{n}"] = ObjectImage(base)
    return _into(made.object, base)


def _rotate(made: Composition, n: int) -> Goals:
    target = made.new_object(asymmetric=True)
    made.fills[f"object_{n}"] = ObjectImage(target)
    return _rotate_defined(made, n)


def _rotate_defined(made: Composition, n: int) -> Goals:
    assert made.object
    angle_deg = made.fills[f"angle_{n}"] = made.table.choose(ANGLES_DEG)
    return (rotation_goal(made.object, angle_deg, position_m=TOLERANCE.position_m),)


def _restore(made: Composition, n: int) -> Goals:
    assert made.object
    return (AtPose(made.object.id, made.object.pose, TOLERANCE),)


def _define(made: Composition, n: int) -> Goals:
    defined = made.new_object(asymmetric=True)
    made.fills["name"] = made.table.shuffled(NOUNS)[0]
    made.fills[f"object_{n}"] = gray_image(defined)
    made.shapes.add(defined.object)
    return ()


def _gather(made: Composition, n: int) -> Goals:
    base, pool = made.new_base(), made.table.pool
    made.fills[f"base_{n}"] = ObjectImage(base)
    gathered = [made.put(pool.dragged_objects, (base.texture,)) for _ in range(2)]
    made.textures.add(base.texture)
    return tuple(goal for p in gathered for goal in _into(p, base))


def _rearrange(made: Composition, n: int) -> Goals:
    moved = made.new_object()
    place = made.table.find_place("target", moved, tries=_TRIES, apart_m=APART_M)
    if place.pose.planar_distance(moved.pose) < 2 * APART_M:
        raise SamplingError("the target is too near to the start.")
    made.places.append(place)
    made.fills[f"scene_{n}"] = SceneImage.of([place])
    return (AtPose(moved.id, place.pose, TOLERANCE),)


def _neighbor(made: Composition, n: int) -> Goals:
    assert made.object and made.base
    table, dragged = made.table, made.object
    direction, step = table.choose(list(NEIGHBOURS.items()))

    def is_elsewhere(new: Placement) -> bool:
        along, across = offset(new, dragged, step)
        return not (0 < along < _NEIGHBOR_M + 0.06 and across < 0.05)

    appearance = table.choose([each for each in table.appearances() if each not in made.appearances])
    neighbor = table.place_one(
        "neighbor", lambda: appearance, tries=200, apart_m=APART_M, reject=is_elsewhere
    )
    made.appearances.add(appearance)
    made.directions.append((dragged, step, neighbor))
    made.fills[f"direction_{n}"] = direction
    return _into(neighbor, made.base)


INSTRUCTIONS: dict[str, tuple[str, Callable[[Composition, int], Goals]]] = {
    "define": ("this is a {name} {object_N}", _define),
    "gather": ("put all objects with the same texture as {base_N} into it", _gather),
    "neighbor": ("put the object that was previously at its {direction_N} into the same {base_M}", _neighbor),
    "put": ("put the {object_N} into the {base_N}", _put),
    "put_defined": ("put the {name} into the {base_N}", _put_it),
    "put_it": ("put it into the {base_N}", _put_it),
    "rearrange": ("rearrange to this {scene_N}", _rearrange),
    "restore": ("restore it", _restore),
    "rotate": ("rotate the {object_N} {angle_N} degrees", _rotate),
    "rotate_defined": ("rotate the {name} {angle_N} degrees", _rotate_defined),
}
"""Text of each instruction, N for its number and M for the one before, and what it puts on the table."""


def template(kinds: tuple[str, ...]) -> str:
    """Return the prompt of a composition with its slots."""
    sentences = []
    for n, kind in enumerate(kinds, 1):
        text = INSTRUCTIONS[kind][0].replace("_N}", f"_{n}}}").replace("_M}", f"_{n - 1}}}")
        begins = n == 1 or kinds[n - 2] == "define"
        sentences.append(f"{text[0].upper()}{text[1:]}." if begins else f"Then {text}.")
    return " ".join(sentences)


def compose_problem(table: TableSampler, kinds: tuple[str, ...], num_distractors: int) -> Problem:
    """Place what all instructions need, and distractors; build the problem."""
    made, stages = Composition(table), []
    for n, kind in enumerate(kinds, 1):
        if goals := INSTRUCTIONS[kind][1](made, n):
            stages.append((kind, goals))
    meant = list(table.placements)
    for _ in range(num_distractors):
        made.put(*_look_alikes(table, table.choose(meant), made), what="distractor")
    for dragged, step, neighbor in made.directions:
        reach = 2 * dragged.pose.planar_distance(neighbor.pose)
        for other in table.placements:
            along, across = offset(other, dragged, step)
            if other not in (dragged, neighbor) and 0 < along < reach and across < along:
                raise SamplingError("another object lies in the direction of the neighbor.")
    goals = tuple(goal for _, group in stages for goal in group)
    first = len(stages[0][1])
    restored = {goals.index(group[0]) for kind, group in stages if kind == "restore"}
    later = tuple(index for index in range(first, len(goals)) if index not in restored)
    others = [p for p in table.placements if p not in meant]
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(template(kinds), **made.fills),
        goals=goals,
        constraints=(InOrder(later), DistractorsApart.of(others)),
        stages=tuple(len(group) for _, group in stages),
        oracle_max_steps=len(goals) + _SPARE_STEPS,
    )


def _look_alikes(
    table: TableSampler, like: Placement, made: Composition
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return shapes and textures of a distractor that shares one of them with an object, where it may."""
    pool = table.pool
    shapes = pool.base_objects if like.fixed else pool.dragged_objects
    textures = (*pool.dragged_textures, *pool.base_textures)
    options = [((like.object,), textures)] * (like.object not in made.shapes)
    options += [(shapes, (like.texture,))] * (like.texture not in made.textures)
    return table.choose(options or [(shapes, textures)])


def _register(name: str, kinds: tuple[str, ...]) -> None:
    @register_task(
        name,
        family="instruction_composition",
        template=template(kinds),
        oracle_max_steps=len(kinds) + 1 + _SPARE_STEPS,
        summary=f"instructions in one prompt: {', '.join(kinds).replace('_', ' ')}.",
    )
    def sample(table: TableSampler, *, num_distractors: FewDistractors = 2) -> Problem:
        """Sample one problem.

        Args:
            table: Sampler of the scene.
            num_distractors: Further objects, 0 … 3.
        """
        return compose_problem(table, kinds, num_distractors)


for _name, _kinds in COMPOSITIONS.items():
    _register(_name, _kinds)
