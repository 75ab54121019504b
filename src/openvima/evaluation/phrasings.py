"""Held-out phrasings of prompts: twenty of each of five tasks, never trained on."""

import numpy as np

from openvima.tasks.prompts import Phrasings, read_phrasings, rephrased
from openvima.tasks.registry import task_spec


def held_out_phrasings() -> Phrasings:
    """Return the phrasings by task."""
    return read_phrasings("openvima.evaluation", "phrasings.yaml")


def has_phrasings(task: str) -> bool:
    """Whether a task has held-out phrasings."""
    return task in held_out_phrasings()


def in_held_out_phrasing(text: str, task: str, rng: np.random.Generator) -> str:
    """Return the text of a task's prompt in one of its held-out phrasings.

    Args:
        text: The text, with images or descriptions. Another form, such as a corrupted one, is unchanged.
        task: Name of the task.
        rng: Draws the phrasing.
    """
    phrasings = held_out_phrasings()[task]
    return rephrased(text, task_spec(task).template, phrasings[int(rng.integers(len(phrasings)))]) or text
