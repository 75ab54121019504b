"""Clutter of level L5: up to ten more objects on the table, look-alikes among them.

A task is sampled as at L3, then objects are added that its prompt does not mean. What a prompt means is
in `MEANT_BY`; an added object differs from all that are meant in that attribute, so that the prompt has
one reading as before. Two thirds share a shape or a texture with an object of the goals; the first is tall
and stands, where there is room, between such an object and the front camera. Where six bases fill the table,
objects lie in those that are not meant. To rearrange means to clear: an object of the same shape is where one
of those shown is to go.
"""

import contextlib
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from openvima.catalog import OBJECT_SETS, TEXTURE_SETS, Vector3, object_spec
from openvima.errors import SamplingError
from openvima.scene import AtPose, DistractorsApart, InZone, Placement, Problem, ZoneKeptClear
from openvima.scene.goal import object_of
from openvima.tasks.table import NO_SCALE, Appearance, Reject, TableSampler, is_in_the_way, offset

LEVEL = "L5"
LEAST, MOST = 3, 10  # objects added
BASES = OBJECT_SETS["B_novel"]
OBJECTS = (*OBJECT_SETS["D_novel"], *BASES)
TEXTURES = TEXTURE_SETS["T"]

Attribute = Literal["appearance", "shape", "texture", "profile"]
MEANT_BY: dict[str, tuple[Attribute, Attribute]] = {
    "scene_understanding": ("appearance", "texture"),
    "novel_adj": ("shape", "shape"),
    "novel_noun": ("shape", "shape"),
    "twist": ("texture", "texture"),
    "same_shape": ("profile", "profile"),
}
"""How prompts tell objects to move, and bases; elsewhere by appearance: shape and texture."""

_OF: dict[Attribute, Callable[[str, str], object]] = {
    "appearance": lambda shape, texture: (shape, texture),
    "shape": lambda shape, texture: shape,
    "texture": lambda shape, texture: texture,
    "profile": lambda shape, texture: object_spec(shape).profile,
}
_GAP_M = 0.03  # between an added object and what decides an episode
_TALL = (1.0, 1.0, 2.5)
_HIDING_M = (0.06, 0.2)  # distance in front of the object that is hidden
_HIDING_WIDTH_M = 0.05
_HIDING_TRIES = 40
_SWEPT_TABLE_Y_M = 0.36  # beside the area, blocks and paths of sweeps


def add_clutter(table: TableSampler, problem: Problem, task: str) -> Problem:
    """Return a problem with more objects, none of them meant and all of them distractors.

    Args:
        table: Sampler of the scene, with the problem's objects placed.
        problem: As the task sampled it.
        task: Its name.

    Raises:
        SamplingError: Fewer than four objects found a place.
    """
    num_before, count = len(table.placements), int(table.rng.integers(LEAST + 3, MOST + 1))
    if task == "rearrange" and not problem.prerequisites:
        problem = _occupy_a_target(table, problem)
    scene, goals = problem.scene, problem.goals
    moved = [scene[i] for i in dict.fromkeys(object_of(goal) for goal in goals) if i is not None]
    bases = [scene[i] for i in {getattr(goal, "relative_to", None) for goal in goals} if i is not None]
    by_moved, by_base = MEANT_BY.get(task, ("appearance", "appearance"))
    forbidden = {(p.object, p.texture) for p in scene.placements}
    meant: list[tuple[Attribute, object]] = [
        *((by_moved, _OF[by_moved](p.object, p.texture)) for p in moved),
        *((by_base, _OF[by_base](p.object, p.texture)) for p in bases if p not in moved),
    ]

    def draw(but: tuple[str, ...] = ()) -> Appearance:
        like = table.choose((*moved, *bases))
        while True:
            shape, texture = table.choose(OBJECTS), table.choose(TEXTURES)
            shape, texture = table.choose(((shape, texture), (like.object, texture), (shape, like.texture)))
            differs = all(_OF[attribute](shape, texture) != value for attribute, value in meant)
            if differs and shape not in but and (shape, texture) not in forbidden:
                return shape, texture

    blocks = _blocks_for(task, problem, moved)

    def put(*, tries: int, scale: Vector3, reject: Reject) -> None:
        with contextlib.suppress(SamplingError):
            new = table.place_one("clutter", draw, tries=tries, scale=scale, reject=reject)
            forbidden.add((new.object, new.texture))

    free_bases = [p for p in scene.placements if p.fixed and p not in bases]
    for base in free_bases if task == "pick_in_order_then_restore" else ():
        shape, texture = draw(BASES)
        table.add(shape, texture, pose=base.pose, fixed=False, on_top=True)
        forbidden.add((shape, texture))
    hidden = table.choose((*moved, *bases))
    put(
        tries=_HIDING_TRIES,
        scale=_TALL,
        reject=lambda new: not _hides(new, hidden) or blocks(new),
    )
    while count > len(table.placements) - num_before:
        before = len(table.placements)
        put(tries=20, scale=NO_SCALE, reject=blocks)
        if len(table.placements) == before:
            break
    added = tuple(p.id for p in table.placements[num_before:])
    if len(added) < LEAST:
        raise SamplingError(f"only {len(added)} objects of clutter found a place.")
    zones = {goal.zone for goal in goals if isinstance(goal, InZone)}
    at_end = any(isinstance(c, DistractorsApart) and c.at_end for c in problem.constraints)
    new = [ZoneKeptClear(added, zone) for zone in zones] or [DistractorsApart(added, at_end=at_end)]
    return replace(problem, scene=table.scene(), constraints=(*problem.constraints, *new))


def _occupy_a_target(table: TableSampler, problem: Problem) -> Problem:
    """Place a look-alike on the target of an object; the oracle clears it first."""
    goal = table.choose([goal for goal in problem.goals if isinstance(goal, AtPose)])
    like = problem.scene[goal.object_id]
    taken = [p.texture for p in problem.scene.placements if p.object == like.object]
    texture = table.choose([texture for texture in TEXTURES if texture not in taken])
    blocks = _blocks_for("rearrange", problem, [])
    new = table.add(like.object, texture, size=like.size, pose=goal.target, fixed=False)
    if any(is_in_the_way(new, other) for other in problem.scene.placements):
        raise SamplingError("the object on the target crowds another.")
    place = table.find_place("parking place", new, tries=_HIDING_TRIES, reject=blocks)
    clearing = AtPose(new.id, place.pose, goal.tolerance)
    return replace(problem, scene=table.scene(), prerequisites=(clearing,))


def _hides(new: Placement, hidden: Placement) -> bool:
    """Whether an object stands between another one and the front camera, which looks towards the robot."""
    dx, dy = new.pose.x - hidden.pose.x, new.pose.y - hidden.pose.y
    return _HIDING_M[0] < dx < _HIDING_M[1] and abs(dy) < _HIDING_WIDTH_M


def _blocks_for(task: str, problem: Problem, moved: list[Placement]) -> Reject:
    """Return a test for placements that decide the episode, are in the way, or change what is meant."""
    moves = [goal for goal in (*problem.goals, *problem.prerequisites) if isinstance(goal, AtPose)]
    places = [(problem.scene[goal.object_id].at(goal.target), goal.tolerance.position_m) for goal in moves]
    places += [(problem.scene[goal.object_id], goal.tolerance.position_m) for goal in moves]

    def blocks(new: Placement) -> bool:
        if any(isinstance(goal, InZone) for goal in problem.goals):
            return abs(new.pose.y) < _SWEPT_TABLE_Y_M
        if any(is_in_the_way(new, place, reach_m + _GAP_M) for place, reach_m in places):
            return True
        return task == "manipulate_old_neighbor" and _is_neighbour(new, *moved)

    return blocks


def _is_neighbour(new: Placement, dragged: Placement, neighbour: Placement) -> bool:
    """Whether an object lies in the direction of a neighbour, and not much farther away."""
    line = (neighbour.pose.x - dragged.pose.x, neighbour.pose.y - dragged.pose.y)
    length = dragged.pose.planar_distance(neighbour.pose)
    along, across = (part / length for part in offset(new, dragged, line))
    return 0 < along < 2 * length and across < along
