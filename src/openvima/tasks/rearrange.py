"""`rearrange`: move objects to their places in a goal image, and clear a blocked target first.

Scene:    one to three objects away from their targets. A single object has a distractor, which is on the
          target in half of the episodes.
Prompt:   "Rearrange to this {scene}."
Success:  each object was within 0.1 m of its target, and at the end the distractor is as near to neither
          object nor target.
Source:   VIMA paper, task list of the appendix, "Rearrange".
"""

from typing import Literal

from openvima.catalog import TEXTURE_SETS
from openvima.errors import SamplingError
from openvima.scene import AtPose, DistractorsApart, Placement, Problem, Prompt, SceneImage, Tolerance
from openvima.tasks.options import Difficulty, SomeDistractors
from openvima.tasks.registry import register_task
from openvima.tasks.table import Appearance, Reject, TableSampler, is_in_the_way

TEMPLATE = "Rearrange to this {scene}."
TOLERANCE = Tolerance(position_m=0.1)
NUM_OBJECTS_WEIGHTS = (0.4, 0.4, 0.2)
CONFLICT_RATE = 0.5  # probability that the distractor is on the target
_APART_M = TOLERANCE.position_m + 0.01  # of a distractor from starts; margin for an object put down askew
_TRIES = 20


@register_task("rearrange", family="visual_goal_reaching", template=TEMPLATE, oracle_max_steps=5)
def sample(
    table: TableSampler,
    *,
    num_distractors: SomeDistractors = None,
    distractor_textures: Literal["all", "pool"] = "all",
    difficulty: Difficulty = "easy",
) -> Problem:
    """Sample one problem.

    Args:
        table: Sampler of the scene.
        num_distractors: Distractors, 0 … 6; by default one for a single object, else none.
        distractor_textures: "all" 49 light textures, as in the benchmark at every level, or "pool": only
            those of the level.
        difficulty: "easy", "medium" or "hard"; without effect, as in the benchmark.
    """
    objects, textures = table.pool.dragged_objects, table.pool.dragged_textures
    textures_of = {"all": TEXTURE_SETS["T"], "pool": textures}
    num_objects = 1 + int(table.rng.choice(len(NUM_OBJECTS_WEIGHTS), p=NUM_OBJECTS_WEIGHTS))
    if num_distractors is None:
        num_distractors = int(num_objects == 1)

    targets = table.place(
        "object at its target",
        table.drawing(objects, textures),
        count=num_objects,
        tries=num_objects + 10,
    )
    in_the_way = _in_the_way_of(targets, table)
    starts = [
        table.move(target, table.find_place("start", target, reject=in_the_way))
        for target in reversed(targets)
    ][::-1]
    moved = {target.object for target in targets}
    distractors: list[Placement] = []
    parking: list[Placement] = []
    for n in range(num_distractors):
        appearance = (
            table.choose([name for name in objects if name not in moved]),
            table.choose(textures_of[distractor_textures]),
        )
        if n == 0 and num_objects == 1 and table.rng.random() < CONFLICT_RATE:
            distractor, place = _on_target(table, appearance, starts[0], targets[0])
            parking.append(place)
            in_the_way = _in_the_way_of([*targets, place], table)
        else:
            distractor = table.place_one(
                "distractor",
                lambda drawn=appearance: drawn,
                tries=_TRIES,
                apart_m=_APART_M,
                reject=in_the_way,
            )
        distractors.append(distractor)
    return Problem(
        scene=table.scene(),
        prompt=Prompt.parse(TEMPLATE, scene=SceneImage.of(targets)),
        goals=tuple(AtPose(target.id, target.pose, TOLERANCE) for target in targets),
        constraints=(DistractorsApart.of(distractors, at_end=True),),
        prerequisites=tuple(AtPose(place.id, place.pose, TOLERANCE) for place in parking),
    )


def _on_target(
    table: TableSampler, appearance: Appearance, start: Placement, target: Placement
) -> tuple[Placement, Placement]:
    """Place the distractor on the target; return it there and at its parking place."""
    z = target.pose.z if table.compat else None  # as in VIMA-Bench, at the height of the object
    distractor = table.add(*appearance, pose=target.pose, z=z)
    if not table.compat and is_in_the_way(distractor, start):
        raise SamplingError("the distractor on the target crowds the object's start.")
    in_the_way = _in_the_way_of([target], table)
    parking = table.find_place("parking place", distractor, tries=_TRIES, apart_m=_APART_M, reject=in_the_way)
    return distractor, parking


def _in_the_way_of(targets: list[Placement], table: TableSampler) -> Reject:
    """Return a test for placements that crowd or, without `compat`, reach a target."""
    reach = 0.0 if table.compat else TOLERANCE.position_m

    return lambda place: any(is_in_the_way(place, target, reach) for target in targets)
