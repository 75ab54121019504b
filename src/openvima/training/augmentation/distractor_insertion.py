"""Scene augmentation: objects of another demonstration are inserted as distractors (copy-paste)."""

from dataclasses import replace
from functools import cache

import numpy as np

from openvima.errors import UnknownTaskError
from openvima.perception.iou import box_iou
from openvima.perception.preprocessing import ObjectTable
from openvima.tasks.registry import task_spec
from openvima.training.dataset import Example

MAX_DISTRACTORS = 3


@cache
def allows_distractors(task: str) -> bool:
    """Whether demonstrations of a task stay correct with distractors, see `TaskSpec.distractors_allowed`."""
    try:
        return task_spec(task).distractors_allowed
    except UnknownTaskError:  # demonstrations of a task that is not installed here
        return False


def with_distractors(example: Example, rng: np.random.Generator) -> Example:
    """Insert up to three objects of another demonstration, where they are, at all steps.

    Their boxes overlap no other box of any step. Only table rows are copied, no images. In few episodes a
    distractor matches the prompt as well as the target does, which makes the prompt ambiguous.

    Args:
        example: The demonstration. Distractors come from the first step of `example.other`, if the loader
            supplied one; its images are part of the same stack.
        rng: Draws how many, and which.

    Returns:
        The demonstration with numbers of images that count through the whole stack.
    """
    other = example.other
    if other is None:
        return example
    episode = example.episode.with_image_offset(example.base)
    count = int(rng.integers(1, MAX_DISTRACTORS + 1))
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
        example, content=replace(episode, objects=objects, objects_per_step=objects_per_step), base=0
    )


def _boxes_by_view(objects: ObjectTable) -> tuple[np.ndarray, np.ndarray]:
    """Boxes, (2, N, 4), and visibility, (2, N)."""
    return objects.boxes.swapaxes(0, 1), objects.masks.T
