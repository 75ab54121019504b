"""Demonstrations into whose view objects of others come, so that policies look at what the prompt names."""

from dataclasses import replace

import numpy as np

from openvima.data.object_cache.episode import PreprocessedEpisode
from openvima.perception.iou import box_iou
from openvima.perception.preprocessing import ObjectTable
from openvima.training.dataset import Example

MOST_STRANGERS = 3
# Tasks whose prompts show whatever matters. "All objects …" or "the object that was to the left" could mean a
# stranger, and in a scene to be restored it would lie in the way.
RECEIVING = ("visual_manipulation", "rotate", "novel_adj", "novel_noun", "pick_in_order_then_restore")


def receives_strangers(episode: PreprocessedEpisode) -> bool:
    """Whether what an episode demonstrates stays right with other objects in view."""
    return episode.task in RECEIVING


def with_strangers(example: Example, other: Example, rng: np.random.Generator) -> Example:
    """Put up to three objects of another demonstration into view, at all steps where they lie there.

    They lie where no view shows anything else at any step. Nothing is copied but rows of numbers. In few
    episodes a stranger is what the prompt shows as well as the object meant; which it is then cannot be told.

    Args:
        example: The demonstration.
        other: Another one, whose images are part of the same stack; objects of its first step are taken.
        rng: Draws how many, and which.

    Returns:
        The demonstration with numbers of images that count through the whole stack.
    """
    episode = example.episode.with_image_offset(example.base)
    count = int(rng.integers(1, MOST_STRANGERS + 1))
    there = other.episode.objects.select(slice(0, int(other.episode.objects_per_step[0])))
    there = there.with_image_offset(other.base).select(rng.permutation(len(there)))
    there = there.select(np.asarray(there.masks.all(axis=1)))
    taken = box_iou(*_boxes_by_view(there), *_boxes_by_view(episode.objects)) > 0
    there = there.select(np.flatnonzero(~taken.any(axis=1))[:count])
    there = replace(there, ids=episode.objects.ids.max(initial=-1) + 1 + np.arange(len(there)))
    steps = episode.objects.split(episode.objects_per_step)
    objects = ObjectTable.concatenate([table for step in steps for table in (step, there)])
    objects_per_step = episode.objects_per_step + len(there)
    return replace(
        example, episode=replace(episode, objects=objects, objects_per_step=objects_per_step), base=0
    )


def _boxes_by_view(objects: ObjectTable) -> tuple[np.ndarray, np.ndarray]:
    """Boxes, (2, N, 4), and visibility, (2, N)."""
    return objects.boxes.swapaxes(0, 1), objects.masks.T
