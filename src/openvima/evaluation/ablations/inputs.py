"""What a policy gets under an input ablation."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from openvima.perception.boxes import BoxJitter
from openvima.scene import RenderedPrompt


@dataclass(frozen=True, slots=True, eq=False)
class AblatedInput:
    """Inputs of a policy in one episode.

    Args:
        prompt: The prompt.
        id_map: Maps each object id to that in observations, shape (256,), uint8; None is the identity.
        jitter: Moves the boxes of observations; None leaves them.
    """

    prompt: RenderedPrompt
    id_map: np.ndarray | None = None
    jitter: BoxJitter | None = None

    def observation(self, observation: Mapping[str, Any]) -> Mapping[str, Any]:  # Any: as the environment's
        """Return the next observation of the episode, with mapped ids and moved boxes."""
        if self.id_map is not None and "segm" in observation:
            observation = {**observation, "segm": renumbered(observation["segm"], self.id_map)}
        return observation if self.jitter is None else self.jitter.observation(observation)


def renumbered(segm: Mapping[str, np.ndarray], id_map: np.ndarray) -> dict[str, np.ndarray]:
    """Map the ids of a segmentation, view by view."""
    return {view: id_map[ids] for view, ids in segm.items()}
