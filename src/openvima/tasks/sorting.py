"""Shared part of the sorting tasks of level L8: groups of objects, each into a container of its own."""

import math
from collections.abc import Callable, Mapping, Sequence

from openvima.scene import AtPose, DistractorsApart, ObjectImage, Placement, Pose, Problem, Prompt, Tolerance
from openvima.tasks.table import Appearance, Draw, TableSampler

NUM_GROUPS = 3
LEAST, MOST = 6, 8  # objects to sort
MAX_DISTRACTORS = 3
TOLERANCE = Tolerance(position_m=0.125)  # as where several objects are gathered in one base
MIDDLE_X, BASES_M, ROWS_M = 0.5, 0.16, (0.025, 0.175)  # m, of the table, and rows on either side of it
BASES_Y, COLUMNS_Y = (-0.32, 0.0, 0.32), tuple(0.16 * (n - 2.5) for n in range(6))  # m
_SPARE_STEPS = 3

Fill = ObjectImage | str


def sorting_problem(
    table: TableSampler,
    template: str,
    *,
    draw: Callable[[int], Appearance],
    draw_distractor: Draw,
    base_textures: Sequence[str],
    describe: Callable[[int, Sequence[Placement]], Mapping[str, Fill]],
    num_distractors: int,
) -> Problem:
    """Place three containers, the objects of three groups and distractors, and build the problem.

    Args:
        table: Sampler of the scene.
        template: The prompt, with slots `base_1` to `base_3` and those of `describe`.
        draw: Draws the appearance of an object of a group, 0 … 2.
        draw_distractor: Draws that of an object of no group.
        base_textures: Textures of containers, which all differ.
        describe: Returns the fills of the prompt that name a group, from its number and its objects.
        num_distractors: Objects of no group, 0 … 3.
    """
    num_objects = int(table.rng.integers(LEAST, MOST + 1))
    textures = table.distinct(base_textures, NUM_GROUPS)
    side = table.choose((-1, 1))  # of the table where the containers are
    bases = [
        _put(table, (table.choose(table.pool.base_objects), texture), MIDDLE_X + side * BASES_M, y)
        for texture, y in zip(textures, table.shuffled(BASES_Y), strict=True)
    ]
    cells = table.shuffled([(MIDDLE_X - side * row, y) for row in ROWS_M for y in COLUMNS_Y])
    groups: list[list[Placement]] = [[] for _ in bases]
    for number in range(num_objects):
        group = number % NUM_GROUPS
        groups[group].append(_put(table, draw(group), *cells.pop(), turns=int(table.rng.integers(4))))
    others = [
        _put(table, draw_distractor(), *cells.pop(), turns=int(table.rng.integers(4)))
        for _ in range(num_distractors)
    ]

    goals = [
        AtPose.into(p, base, TOLERANCE) for base, group in zip(bases, groups, strict=True) for p in group
    ]
    constraints = []
    for base, group in zip(bases, groups, strict=True):
        strange = tuple(p.id for other in (*groups, others) if other is not group for p in other)
        mine = tuple(index for index, goal in enumerate(goals) if goal.relative_to == base.id)
        constraints.append(DistractorsApart(strange, goals=mine))
    fills: dict[str, Fill] = {f"base_{n}": ObjectImage(base) for n, base in enumerate(bases, 1)}
    for number, group in enumerate(groups):
        fills |= describe(number, group)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(template, **fills),
        goals=tuple(goals),
        constraints=tuple(constraints),
        oracle_max_steps=num_objects + _SPARE_STEPS,
    )


def _put(table: TableSampler, appearance: Appearance, x: float, y: float, *, turns: int = 0) -> Placement:
    """Add an object, turned by a multiple of 90 degrees so that it stays in its cell."""
    pose = Pose.planar(x, y, turns * math.pi / 2)
    return table.add(*appearance, pose=pose)
