"""Putting one object into one base: what the tasks of that kind share."""

from collections.abc import Callable, Sequence

from openvima.scene import AtPose, DistractorsApart, Placement, Problem, Prompt, Tolerance
from openvima.tasks.table import TableSampler

TOLERANCE = Tolerance(position_m=0.1)
APART_M = TOLERANCE.position_m  # nearer, and the episode would be decided at the start


def place_base_and_target(
    table: TableSampler, *, dragged_textures: Sequence[str], base_textures: Sequence[str]
) -> tuple[Placement, Placement]:
    """Put a base and an object to move on the table.

    Args:
        table: The table to lay.
        dragged_textures: Textures to choose from for the object.
        base_textures: Textures to choose from for the base.

    Returns:
        Base and object.
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
    """Put distractors on the table, as `draw` gives their object and texture."""
    return table.place("distractor", draw, count=count, tries=count + 10, apart_m=APART_M)


def of_a_third_shape(
    table: TableSampler, base: Placement, target: Placement, textures: Sequence[str]
) -> Callable[[], tuple[str, str]]:
    """Draw distractors of any shape, bases included, but that of the base and that of the target.

    Args:
        table: Its pool says which shapes there are.
        base: The base.
        target: The object to move.
        textures: Textures to choose from; one that is listed twice comes twice as often.

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
    """Ask for the target to be put into the base, while no distractor is near either of them."""
    return Problem(
        scene=table.scene(),
        prompt=prompt,
        goals=(AtPose(target.id, base.pose, TOLERANCE, relative_to=base.id),),
        constraints=(DistractorsApart(tuple(distractor.id for distractor in distractors)),),
    )
