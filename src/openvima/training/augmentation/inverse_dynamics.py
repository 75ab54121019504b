"""Inverse dynamics: the prompt consists of the frames of the demonstration, and the actions are predicted.

    "Follow this motion: {frame_0} {frame_1} … {frame_T}."

Any demonstration of T steps can be used that way, whatever its task. The frames are the observations before
each action and after the last.

Source: MIDAS (Li et al. 2023), inverse-dynamics pretraining.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from openvima.data.preprocessed import PreprocessedEpisode
from openvima.perception.preprocessing import ObjectTable, PreprocessedPrompt
from openvima.scene import ObjectRecord, PromptImage, RenderedPrompt

MOTION_TEXT = "Follow this motion: {frames}."


def with_motion_prompt(episode: PreprocessedEpisode) -> PreprocessedEpisode:
    """Replace the prompt by the frames of the demonstration.

    Only table rows are copied: the prompt refers to the images of the history. Nothing is left of the task's
    own prompt.

    Args:
        episode: The demonstration. In a prompt image its objects are ordered by id, as in the scenes of task
            prompts. Objects without any box, which stand for steps without detections, are left out.
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
    """Make the prompt of an in-context demonstration.

    Args:
        observations: `rgb` and `segm`, each view name to array.
        objects: The objects of the scene.
    """
    records = tuple(sorted(objects, key=lambda record: record.object_id))
    images = {}
    for number, seen in enumerate(observations):
        name = f"frame_{number}"
        images[name] = PromptImage(name, "scene", dict(seen["rgb"]), dict(seen["segm"]), records)
    return RenderedPrompt(motion_text(len(images)), images)


def motion_text(num_frames: int) -> str:
    """Return the text for so many frames, with a placeholder for each."""
    frames = " ".join(f"{{frame_{number}}}" for number in range(num_frames))
    return MOTION_TEXT.format(frames=frames)
