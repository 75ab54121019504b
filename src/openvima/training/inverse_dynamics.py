"""Demonstrations read as motions: what was seen is the prompt, and what was done the answer.

    "Follow this motion: {frame_0} {frame_1} … {frame_T}."

Any demonstration of T steps can be read that way. A network learns by it what moved from frame to frame and
how to bring that about, from the same data and whatever the task was. The frames show what the policy saw
before each action and after the last.

Source: MIDAS (Li et al. 2023), inverse dynamics pretraining.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from openvima.data.object_cache.episode import COUNT, ID, NUMBERS, PROMPT_WIDTH, PreprocessedEpisode
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt

MOTION_TEXT = "Follow this motion: {frames}."


def as_motion(episode: PreprocessedEpisode) -> PreprocessedEpisode:
    """Return the same demonstration with its own frames as the prompt.

    Nothing is copied but rows of numbers: the prompt names the images of the history. Nothing is left of the
    task's own prompt.

    Args:
        episode: The demonstration. Its objects may be in any order; in a prompt image they stand in that of
            their ids, as the scenes in the prompts of tasks have it. One that no view shows, as it stands
            for a moment in which a detector found nothing, is left out.
    """
    rows = np.concatenate([episode.objects[:, :PROMPT_WIDTH], episode.final])
    frame = np.repeat(np.arange(episode.num_steps + 1), [*episode.steps[:, COUNT], len(episode.final)])
    shown = rows[:, NUMBERS].any(axis=1)
    rows, frame = rows[shown], frame[shown]
    return replace(
        episode,
        text=motion_text(episode.num_steps + 1),
        prompt_counts=np.bincount(frame, minlength=episode.num_steps + 1).astype(np.int32),
        prompt=rows[np.lexsort((rows[:, ID], frame))],
    )


def motion_prompt(observations: Sequence[Mapping], objects: Sequence[ObjectRecord]) -> RenderedPrompt:
    """Make the prompt that shows a motion, for a policy that acts.

    Args:
        observations: What was seen: `rgb` and `segm`, each view name to array.
        objects: The objects of the scene.
    """
    records = tuple(sorted(objects, key=lambda record: record.object_id))
    images = {}
    for number, seen in enumerate(observations):
        name = f"frame_{number}"
        images[name] = PromptImage(name, "scene", dict(seen["rgb"]), dict(seen["segm"]), records)
    return RenderedPrompt(motion_text(len(images)), images)


def motion_text(num_frames: int) -> str:
    """Return the text of a motion of so many frames, with a placeholder for each."""
    frames = " ".join(f"{{frame_{number}}}" for number in range(num_frames))
    return MOTION_TEXT.format(frames=frames)
