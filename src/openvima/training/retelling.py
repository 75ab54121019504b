"""Which demonstrations of a batch are told otherwise: as motions, in other words, or with more in view."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from openvima.data.object_cache.episode import PreprocessedEpisode
from openvima.training.dataset import Example
from openvima.training.inverse_dynamics import as_motion
from openvima.training.rereading import as_named, in_any_order, without_bystanders
from openvima.training.strangers import with_strangers


@dataclass(frozen=True, slots=True)
class Retelling:
    """Shares of demonstrations; each has either the prompt of a motion or that of its task.

    Args:
        motion_share: Share of demonstrations that are read as motions, see `as_motion`; the others keep the
            prompts of their tasks.
        bystander_share: How probable it is that motions leave an object out, see `without_bystanders`.
        naming_share: Share of the others whose objects get names, see `as_named`.
        reordering_share: Share of the others whose sentences are put into another order, see `in_any_order`.
    """

    motion_share: float = 0.0
    bystander_share: float = 0.0
    naming_share: float = 0.0
    reordering_share: float = 0.0

    def __call__(self, example: Example, rng: np.random.Generator | None) -> Example:
        """Tell a demonstration as is drawn; without a generator as a motion if all are, else as it is."""
        share = self.motion_share
        if rng is None:
            return _reread(example, as_motion) if share == 1 else example
        if share == 1 or (share and rng.random() < share):
            motion = _reread(example, as_motion)
            if not self.bystander_share:
                return motion
            return _reread(motion, without_bystanders, self.bystander_share, rng)
        if example.other is not None:
            example = with_strangers(example, example.other, rng)
        if self.naming_share and rng.random() < self.naming_share:
            example = _reread(example, as_named, rng)
        if self.reordering_share and rng.random() < self.reordering_share:
            example = _reread(example, in_any_order, rng)
        return example


AS_TOLD = Retelling()


def _reread(
    example: Example, change: Callable[..., PreprocessedEpisode], *given: Any
) -> Example:  # Any: its own
    return replace(example, episode=change(example.episode, *given))
