"""Shared parts of tasks: one object into a base, several into it, and rotations in place."""

import math
from collections.abc import Callable, Sequence

from openvima.errors import ConfigError
from openvima.scene import AtPose, DistractorsApart, ObjectImage, Placement, Pose, Problem, Prompt, Tolerance
from openvima.tasks.table import Appearance, Draw, TableSampler, is_in_the_way

TOLERANCE = Tolerance(position_m=0.1)
APART_M = TOLERANCE.position_m  # below this the episode is decided at the start


def place_base(table: TableSampler, texture: str) -> Placement:
    """Place a base of any shape."""
    return table.place_one("base", lambda: (table.choose(table.pool.base_objects), texture))


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
    base = place_base(table, base_texture)
    target = table.place_one(
        "target", lambda: (table.choose(table.pool.dragged_objects), target_texture), apart_m=APART_M
    )
    return base, target


def place_distractors(table: TableSampler, draw: Draw, *, count: int) -> list[Placement]:
    """Place distractors; `draw` returns object and texture."""
    return table.place("distractor", draw, count=count, tries=count + 10, apart_m=APART_M)


def of_a_third_shape(
    table: TableSampler, base: Placement, target: Placement, textures: Sequence[str]
) -> Draw:
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
    return table.drawing(shapes, textures)


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
        goals=(AtPose.into(target, base, TOLERANCE),),
        constraints=(DistractorsApart.of(distractors),),
    )


TOLERANCE_M, BOWL_TOLERANCE_M = 0.125, 0.0875
NUM_DRAGGED = {"easy": 2, "medium": 2, "hard": 3}
NUM_DISTRACTORS = {"easy": 1, "medium": 2, "hard": 3}
_TRIES = 20  # for all objects together
_SPARE_STEPS = 2


def gathering_problem(
    table: TableSampler,
    template: str,
    choices_for: Callable[[Placement], tuple[Sequence[str], Sequence[str], Sequence[str]]],
    *,
    difficulty: str,
    num_distractors: int | None,
    after_bowl: bool | None,
) -> Problem:
    """Place a base and the other objects, and build the problem.

    Distractors have textures of the pool's dragged ones that no dragged object has.

    Args:
        table: Sampler of the scene.
        template: The prompt with the slot `base_obj`.
        choices_for: Returns, for a base, shapes and textures of the dragged objects, drawn independently, and
            shapes of distractors.
        difficulty: "easy", "medium" or "hard": decides the number of dragged objects.
        num_distractors: By default that of the difficulty.
        after_bowl: Whether the bowl's smaller tolerance applies to every base, as in VIMA-Bench after the
            first bowl of an environment. None: with `compat` if the pool contains a bowl.

    Returns:
        The problem; without `compat`, it is undecided at the start.
    """
    base = place_base(table, table.choose(table.pool.base_textures))
    dragged_objects, dragged_textures, distractor_objects = choices_for(base)
    if after_bowl is None:
        after_bowl = table.compat and "bowl" in table.pool.base_objects
    tolerance = Tolerance(BOWL_TOLERANCE_M if after_bowl or base.object == "bowl" else TOLERANCE_M)
    num_dragged = NUM_DRAGGED[difficulty]
    num_distractors = NUM_DISTRACTORS[difficulty] if num_distractors is None else num_distractors
    dragged: list[Placement] = []

    def draw() -> Appearance:
        dragged[:] = table.placements[1 : 1 + num_dragged]
        if len(dragged) < num_dragged:
            objects, textures = dragged_objects, dragged_textures
        else:
            used = {placement.texture for placement in dragged}
            objects = distractor_objects
            textures = [texture for texture in table.pool.dragged_textures if texture not in used]
        return table.choose(objects), table.choose(textures)

    def reject(new: Placement) -> bool:
        if is_in_the_way(new, base):
            return True
        near = (base, *dragged) if len(dragged) == num_dragged else (base,)
        return not table.compat and any(tolerance.accepts(new.pose, other.pose) for other in near)

    placed = table.place("object", draw, count=num_dragged + num_distractors, tries=_TRIES, reject=reject)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(template, base_obj=ObjectImage(base)),
        goals=tuple(AtPose.into(p, base, tolerance) for p in placed[:num_dragged]),
        constraints=(DistractorsApart.of(placed[num_dragged:]),),
        oracle_max_steps=num_dragged + _SPARE_STEPS,
    )


ANGLES_DEG = (30, 60, 90, 120, 150)  # clockwise seen from above, i.e. negative yaw
TOLERANCE_DEG = 15


def rotated_clockwise(pose: Pose, angle_deg: float) -> Pose:
    """Rotate a pose in place, clockwise seen from above for positive angles."""
    return pose.rotated(-math.radians(angle_deg))


def rotation_goal(placement: Placement, angle_deg: float, *, position_m: float) -> AtPose:
    """Return the goal of a rotation in place, within 15 degrees.

    Args:
        placement: The object at its start.
        angle_deg: Positive is clockwise seen from above.
        position_m: Position tolerance in metres.
    """
    tolerance = Tolerance(position_m, yaw_rad=math.radians(TOLERANCE_DEG))
    return AtPose(
        placement.id, rotated_clockwise(placement.pose, angle_deg), tolerance, relative_to=placement.id
    )


def check_angles(angles_deg: Sequence[float]) -> None:
    """Check that there are angles, all beyond the tolerance.

    Raises:
        ConfigError: There are none, or one is within 15 degrees of 0.
    """
    try:
        are_right = all(abs(math.remainder(angle, 360)) > TOLERANCE_DEG for angle in angles_deg)
    except (TypeError, ValueError):  # no numbers, or infinite
        are_right = False
    if not are_right or not angles_deg:
        raise ConfigError(
            f"angles_deg is {angles_deg!r}; give angles of more than {TOLERANCE_DEG} degrees, such as "
            f"{list(ANGLES_DEG)}."
        )
