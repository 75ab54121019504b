"""Demonstrations into whose view objects of others come, so that policies look at what the prompt names."""

from dataclasses import replace

import numpy as np

from openvima.data.object_cache.episode import (
    BOXES,
    COUNT,
    ID,
    NUMBERS,
    SPURIOUS_NUMBERS,
    PreprocessedEpisode,
)
from openvima.perception.iou import box_overlaps
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
    episode, source = _absolute(example), _absolute(other)
    count = int(rng.integers(1, MOST_STRANGERS + 1))
    there = source.objects[: source.steps[0, COUNT]]
    there = there[rng.permutation(len(there))]
    there = there[(there[:, NUMBERS] > 0).all(axis=1)]
    taken = box_overlaps(*_places(there), *_places(episode.objects)) > 0
    there = there[~taken.any(axis=1)][:count].copy()
    there[:, ID] = episode.objects[:, ID].max(initial=-1) + 1 + np.arange(len(there))
    parts = np.split(episode.objects, np.cumsum(episode.steps[:, COUNT])[:-1])
    steps = episode.steps.copy()
    steps[:, COUNT] += len(there)
    objects = np.concatenate([rows for part in parts for rows in (part, there)])
    return replace(example, tokens=replace(episode, steps=steps, objects=objects), base=0)


def _places(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes of objects, (2, N, 4), and which views show them, (2, N)."""
    return rows[:, BOXES].reshape(-1, 2, 4).swapaxes(0, 1), rows[:, NUMBERS].T > 0


def _absolute(example: Example) -> PreprocessedEpisode:
    """The demonstration with its images numbered as in the stack, in 64 bits."""
    episode = example.tokens
    prompt, objects, final = (
        table.astype(np.int64) for table in (episode.prompt, episode.objects, episode.final)
    )
    steps = episode.steps.astype(np.int64)
    for table, columns in (
        (prompt, NUMBERS),
        (objects, NUMBERS),
        (final, NUMBERS),
        (steps, SPURIOUS_NUMBERS),
    ):
        table[:, columns] += np.where(table[:, columns] > 0, example.base, 0)
    return replace(episode, prompt=prompt, objects=objects, final=final, steps=steps)
