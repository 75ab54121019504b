"""Shared parts of tasks whose prompts show the frames of a video."""

import itertools
from collections.abc import Sequence

from openvima.scene import AtPose, Placement, SceneImage, Tolerance

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
