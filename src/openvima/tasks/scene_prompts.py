"""Shared parts of tasks whose prompts show scenes: frames of a video, and goal images of rearrangements."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from openvima.catalog import TEXTURE_SETS
from openvima.errors import ConfigError, SamplingError, unknown_name
from openvima.scene import AtPose, Placement, SceneImage, Tolerance
from openvima.tasks.options import check_count, check_difficulty, check_fraction, check_num_distractors
from openvima.tasks.table import Reject, TableSampler, is_in_the_way

NUM_FRAMES = {"easy": 3, "medium": 4, "hard": 5}
TOLERANCE = Tolerance(position_m=0.1)

Frame = Sequence[Placement]
"""The objects to imitate, in the same order in all frames, with their ids on the table."""


def with_frame_slots(template: str, num_frames: int) -> str:
    """Replace the slot {frames} of a template by {frame_0} {frame_1} …."""
    slots = " ".join(f"{{{name}}}" for name in _names(num_frames))
    return template.replace("{frames}", slots)


def frame_images(frames: Sequence[Frame]) -> dict[str, SceneImage]:
    """Return the images of the slots frame_0, frame_1, …."""
    return {name: SceneImage.of(frame) for name, frame in zip(_names(len(frames)), frames, strict=True)}


def goals_between(frames: Sequence[Frame]) -> tuple[AtPose, ...]:
    """Return a goal for each object that moves between consecutive frames."""
    return tuple(
        AtPose(after.id, after.pose, TOLERANCE)
        for earlier, later in itertools.pairwise(frames)
        for before, after in zip(earlier, later, strict=True)
        if before.pose != after.pose
    )


def _names(num_frames: int) -> list[str]:
    return [f"frame_{index}" for index in range(num_frames)]


NUM_OBJECTS_WEIGHTS = (0.4, 0.4, 0.2)
MAX_OBJECTS = len(NUM_OBJECTS_WEIGHTS)
CONFLICT_RATE = 0.5  # probability that the distractor is on the target
_APART_M = TOLERANCE.position_m + 0.01  # of a distractor from starts; margin for an object put down askew
_TRIES = 20


@dataclass(frozen=True, slots=True)
class Arrangement:
    """A rearrangement problem.

    Args:
        starts: The objects at their starts.
        targets: The same objects at their targets.
        distractor: The distractor; only with a single object.
        parking: The distractor at a free place, if it is on the target.
        more_distractors: Distractors beyond the published number, away from all targets.
    """

    starts: tuple[Placement, ...]
    targets: tuple[Placement, ...]
    distractor: Placement | None = None
    parking: Placement | None = None
    more_distractors: tuple[Placement, ...] = ()

    @property
    def goal_image(self) -> SceneImage:
        """The objects at their targets, without the distractor."""
        return SceneImage.of(self.targets)

    @property
    def goals(self) -> tuple[AtPose, ...]:
        """Each object at its target."""
        return tuple(AtPose(target.id, target.pose, TOLERANCE) for target in self.targets)

    @property
    def prerequisites(self) -> tuple[AtPose, ...]:
        """Clearing of the target by the oracle."""
        return () if self.parking is None else (AtPose(self.parking.id, self.parking.pose, TOLERANCE),)

    @property
    def distractor_ids(self) -> tuple[int, ...]:
        """Ids of all distractors."""
        first = () if self.distractor is None else (self.distractor,)
        return tuple(distractor.id for distractor in (*first, *self.more_distractors))


def sample_arrangement(
    table: TableSampler,
    *,
    num_objects: int | None,
    num_distractors: int | None,
    conflict_rate: float,
    distractor_textures: str,
    difficulty: str,
) -> Arrangement:
    """Sample a rearrangement.

    Args:
        table: Sampler of the scene.
        num_objects: Objects to move, 1 … 3; None draws the number.
        num_distractors: Distractors, 0 … 6; None: one for a single object, else none.
        conflict_rate: Probability that the distractor of a single object is on the target.
        distractor_textures: "all", or "pool": those of the objects to move.
        difficulty: Checked, without effect.

    Returns:
        The arrangement, with all objects placed at their starts.

    Raises:
        ConfigError: An option is invalid.
        SamplingError: No placement was found.
    """
    check_difficulty(difficulty)
    check_fraction("conflict_rate", conflict_rate)
    textures_of = {"all": TEXTURE_SETS["T"], "pool": table.pool.dragged_textures}
    if not isinstance(distractor_textures, str) or distractor_textures not in textures_of:
        raise ConfigError(unknown_name("choice of distractor_textures", distractor_textures, textures_of))
    if num_objects is None:
        num_objects = 1 + int(table.rng.choice(MAX_OBJECTS, p=NUM_OBJECTS_WEIGHTS))
    check_count("num_objects", num_objects, low=1, high=MAX_OBJECTS)
    if num_distractors is None:
        num_distractors = int(num_objects == 1)
    check_num_distractors(num_distractors)

    objects, textures = table.pool.dragged_objects, table.pool.dragged_textures
    targets = table.place(
        "object at its target",
        lambda: (table.choose(objects), table.choose(textures)),
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
    parking = None
    for n in range(num_distractors):
        appearance = (
            table.choose([name for name in objects if name not in moved]),
            table.choose(textures_of[distractor_textures]),
        )
        if n == 0 and num_objects == 1 and table.rng.random() < conflict_rate:
            distractor, parking = _on_target(table, appearance, starts[0], targets[0])
            in_the_way = _in_the_way_of([*targets, parking], table)
        else:
            distractor = table.place_one(
                "distractor",
                lambda drawn=appearance: drawn,
                tries=_TRIES,
                apart_m=_APART_M,
                reject=in_the_way,
            )
        distractors.append(distractor)
    if num_objects > 1:
        return Arrangement(tuple(starts), tuple(targets), more_distractors=tuple(distractors))
    first = distractors[0] if distractors else None
    return Arrangement(tuple(starts), tuple(targets), first, parking, tuple(distractors[1:]))


def _on_target(
    table: TableSampler, appearance: tuple[str, str], start: Placement, target: Placement
) -> tuple[Placement, Placement]:
    """Place the distractor on the target; return it there and at its parking place."""
    size = table.sample_size(appearance[0])
    z = target.pose.z if table.compat else None  # as in VIMA-Bench, at the height of the object
    distractor = table.add(*appearance, size=size, pose=target.pose, z=z)
    if not table.compat and is_in_the_way(distractor, start):
        raise SamplingError("the distractor on the target crowds the object's start.")
    in_the_way = _in_the_way_of([target], table)
    parking = table.find_place("parking place", distractor, tries=_TRIES, apart_m=_APART_M, reject=in_the_way)
    return distractor, parking


def _in_the_way_of(targets: list[Placement], table: TableSampler) -> Reject:
    """Return a test for placements that crowd or, without `compat`, reach a target."""
    reach = 0.0 if table.compat else TOLERANCE.position_m

    def is_blocking(place: Placement) -> bool:
        return any(
            is_in_the_way(place, target) or place.pose.planar_distance(target.pose) < reach
            for target in targets
        )

    return is_blocking
