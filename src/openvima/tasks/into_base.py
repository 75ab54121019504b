"""Shared parts of the tasks that put one object into one base."""

from collections.abc import Callable, Sequence

from openvima.scene import AtPose, DistractorsApart, Placement, Problem, Prompt, Tolerance
from openvima.tasks.table import TableSampler

TOLERANCE = Tolerance(position_m=0.1)
APART_M = TOLERANCE.position_m  # below this the episode is decided at the start


def place_base_and_target(
    table: TableSampler, *, dragged_textures: Sequence[str], base_textures: Sequence[str]
) -> tuple[Placement, Placement]:
    """Place a base and the target.

    Args:
        table: Sampler of the scene.
        dragged_textures: Textures of the target.
        base_textures: Textures of the base.

    Returns:
        Base and target.
    """
    base_texture = table.choose(base_textures)
    target_texture = table.choose(dragged_textures)
    base = table.place_one("base", lambda: (table.choose(table.pool.base_objects), base_texture))
    target = table.place_one(
        "target", lambda: (table.choose(table.pool.dragged_objects), target_texture), apart_m=APART_M
    )
    return base, target


def place_distractors(
    table: TableSampler, draw: Callable[[], tuple[str, str]], *, count: int
) -> list[Placement]:
    """Place distractors; `draw` returns object and texture."""
    return table.place("distractor", draw, count=count, tries=count + 10, apart_m=APART_M)


def of_a_third_shape(
    table: TableSampler, base: Placement, target: Placement, textures: Sequence[str]
) -> Callable[[], tuple[str, str]]:
    """Return a function that draws distractors of any shape but those of base and target.

    Args:
        table: Source of the shapes.
        base: The base.
        target: The target.
        textures: Textures; duplicates count twice.

    Returns:
        A function that draws object and texture.
    """
    shapes = [
        shape
        for shape in (*table.pool.dragged_objects, *table.pool.base_objects)
        if shape not in (base.object, target.object)
    ]
    return lambda: (table.choose(shapes), table.choose(textures))


def into_base(
    table: TableSampler,
    prompt: Prompt,
    *,
    target: Placement,
    base: Placement,
    distractors: Sequence[Placement],
) -> Problem:
    """Return the problem: target into base, distractors apart."""
    return Problem(
        scene=table.scene(),
        prompt=prompt,
        goals=(AtPose(target.id, base.pose, TOLERANCE, relative_to=base.id),),
        constraints=(DistractorsApart(tuple(distractor.id for distractor in distractors)),),
    )
