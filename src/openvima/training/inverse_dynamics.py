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

from openvima.data.object_cache.episode import PreprocessedEpisode
from openvima.perception.preprocessing import ObjectTable, PreprocessedPrompt
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
    objects = ObjectTable.concatenate([episode.objects, episode.final])
    num_frames = episode.num_steps + 1
    frame = np.repeat(np.arange(num_frames), [*episode.objects_per_step, len(episode.final)])
    order = np.lexsort((objects.ids, frame))
    order = order[np.asarray(objects.masks.any(axis=1))[order]]
    prompt = PreprocessedPrompt(
        text=motion_text(num_frames),
        objects=objects.select(order),
        objects_per_image=np.bincount(frame[order], minlength=num_frames).astype(np.int16),
        is_scene=np.ones(num_frames, np.bool_),
    )
    return replace(episode, prompt=prompt)


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
