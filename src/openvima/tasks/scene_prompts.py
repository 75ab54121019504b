"""Shared parts of tasks whose prompts show the frames of a video."""

import itertools
from collections.abc import Sequence

from openvima.scene import (
    AtPose,
    Constraint,
    ObjectImage,
    Placement,
    Problem,
    Prompt,
    Scene,
    SceneImage,
    Tolerance,
)

NUM_FRAMES = {"easy": 3, "medium": 4, "hard": 5}
TOLERANCE = Tolerance(position_m=0.1)

Frame = Sequence[Placement]
"""The objects to imitate, in the same order in all frames, with their ids on the table."""


def with_frame_slots(template: str, num_frames: int) -> str:
    """Replace the slot {frames} of a template by {frame_0} {frame_1} …."""
    slots = " ".join(f"{{{name}}}" for name in _names(num_frames))
    return template.replace("{frames}", slots)


def video_problem(
    scene: Scene,
    template: str,
    images: Sequence[Frame],
    goals: tuple[AtPose, ...],
    constraint: Constraint,
    *,
    spare_steps: int,
    **fills: ObjectImage,
) -> Problem:
    """Build a problem whose goals are to be met one after the other.

    Args:
        scene: The scene.
        template: The prompt, with the slot {frames} for a video.
        images: The objects that each frame of the video shows.
        goals: The goals, in order.
        constraint: The constraint.
        spare_steps: Steps of the oracle beyond one for each goal.
        **fills: Further slots of the prompt.
    """
    frames = dict(zip(_names(len(images)), map(SceneImage.of, images), strict=True))
    return Problem(
        scene,
        Prompt.parse(with_frame_slots(template, len(images)), **fills, **frames),
        goals,
        (constraint,),
        stages=(1,) * len(goals),
        oracle_max_steps=len(goals) + spare_steps,
    )


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
