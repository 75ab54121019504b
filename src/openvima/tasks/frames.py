"""What tasks share whose prompt shows, frame by frame, what has to be done."""

import itertools
from collections.abc import Sequence

from openvima.scene import AtPose, Placement, SceneImage, Tolerance
from openvima.tasks.options import check_count, check_difficulty

NUM_FRAMES = {"easy": 3, "medium": 4, "hard": 5}
TOLERANCE = Tolerance(position_m=0.1)

Frame = Sequence[Placement]
"""The objects to follow, each in the same place in all frames, under the ids that they have on the table."""


def checked_num_frames(num_frames: int | None, difficulty: str, *, high: int) -> int:
    """Return how many frames to show: what was asked for, else what the difficulty says.

    Raises:
        ConfigError: The difficulty is unknown, or the number is not in 2 … `high`.
    """
    check_difficulty(difficulty)
    if num_frames is None:
        return NUM_FRAMES[difficulty]
    check_count("num_frames", num_frames, low=2, high=high)
    return num_frames


def with_frame_slots(template: str, num_frames: int) -> str:
    """Write the slots {frame_0} {frame_1} … in place of the one slot {frames} of a template."""
    slots = " ".join(f"{{{name}}}" for name in _names(num_frames))
    return template.replace("{frames}", slots)


def frame_images(frames: Sequence[Frame]) -> dict[str, SceneImage]:
    """Return what the slots frame_0, frame_1, … show."""
    return {name: SceneImage.of(frame) for name, frame in zip(_names(len(frames)), frames, strict=True)}


def goals_between(frames: Sequence[Frame]) -> tuple[AtPose, ...]:
    """Ask for each object that moved from one frame to the next to go where the later one shows it."""
    return tuple(
        AtPose(after.id, after.pose, TOLERANCE)
        for earlier, later in itertools.pairwise(frames)
        for before, after in zip(earlier, later, strict=True)
        if before.pose != after.pose
    )


def _names(num_frames: int) -> list[str]:
    return [f"frame_{index}" for index in range(num_frames)]
