"""Gathering: put all objects with a property of the base into it."""

from collections.abc import Sequence

from openvima.scene import AtPose, DistractorsApart, ObjectImage, Placement, Problem, Prompt, Tolerance
from openvima.tasks.options import check_count, check_difficulty, check_num_distractors
from openvima.tasks.table import TableSampler, is_in_the_way

TOLERANCE_M, BOWL_TOLERANCE_M = 0.125, 0.0875
NUM_DRAGGED = {"easy": 2, "medium": 2, "hard": 3}
NUM_DISTRACTORS = {"easy": 1, "medium": 2, "hard": 3}
_TRIES = 20  # for all objects together
_SPARE_STEPS = 2


def object_counts(difficulty: str, num_dragged: int | None, num_distractors: int | None) -> tuple[int, int]:
    """Return the number of objects to gather and of distractors.

    Args:
        difficulty: Default for numbers that are None.
        num_dragged: 1 … 3.
        num_distractors: 0 … 6.

    Raises:
        ConfigError: An option is invalid.
    """
    check_difficulty(difficulty)
    num_dragged = NUM_DRAGGED[difficulty] if num_dragged is None else num_dragged
    num_distractors = NUM_DISTRACTORS[difficulty] if num_distractors is None else num_distractors
    check_count("num_dragged", num_dragged, low=1, high=3)
    check_num_distractors(num_distractors)
    return num_dragged, num_distractors


def gathering_problem(
    table: TableSampler,
    template: str,
    *,
    base: Placement,
    dragged_appearances: tuple[Sequence[str], Sequence[str]],
    distractor_objects: Sequence[str],
    counts: tuple[int, int],
    after_bowl: bool | None,
) -> Problem:
    """Place the objects and build the problem.

    Distractors have textures of the pool's dragged ones that no dragged object has.

    Args:
        table: Sampler of the scene, with the base placed.
        template: The prompt with the slot `base_obj`.
        base: The base.
        dragged_appearances: Shapes and textures of the dragged objects, drawn independently.
        distractor_objects: Shapes of distractors.
        counts: Number of dragged objects and of distractors.
        after_bowl: Whether the bowl's smaller tolerance applies to every base, as in VIMA-Bench after the
            first bowl of an environment. None: with `compat` if the pool contains a bowl.

    Returns:
        The problem; without `compat`, it is undecided at the start.
    """
    if after_bowl is None:
        after_bowl = table.compat and "bowl" in table.pool.base_objects
    tolerance = Tolerance(BOWL_TOLERANCE_M if after_bowl or base.object == "bowl" else TOLERANCE_M)
    num_dragged, _ = counts
    dragged: list[Placement] = []

    def draw() -> tuple[str, str]:
        dragged[:] = table.placements[1 : 1 + num_dragged]
        if len(dragged) < num_dragged:
            objects, textures = dragged_appearances
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

    placed = table.place("object", draw, count=sum(counts), tries=_TRIES, reject=reject)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(template, base_obj=ObjectImage(base)),
        goals=tuple(AtPose(p.id, base.pose, tolerance, relative_to=base.id) for p in placed[:num_dragged]),
        constraints=(DistractorsApart(tuple(p.id for p in placed[num_dragged:])),),
        oracle_max_steps=num_dragged + _SPARE_STEPS,
    )
