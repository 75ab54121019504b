"""VIMA as a policy: keeps prompt and history of a batch of episodes and decides each step."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import torch

from openvima.errors import PolicyError
from openvima.policies.vima.heads.base import ACTION_PARTS, ACTION_WIDTH
from openvima.policies.vima.inputs import (
    CropStack,
    StepInput,
    batch_histories,
    batch_prompts,
    read_prompt,
    read_step,
)
from openvima.policies.vima.model import Memory, Vima


@dataclass(slots=True)
class EpisodeHistory:
    """What one episode has shown and what was done about it.

    Args:
        steps: Observations so far.
        features: Encoded crops of each, shape (2, objects, F).
        actions: Actions so far, shape (12,) each.
    """

    steps: list[StepInput] = field(default_factory=list)
    features: list[torch.Tensor] = field(default_factory=list)
    actions: list[torch.Tensor] = field(default_factory=list)


class VimaPolicy:
    """Plays several episodes at once; what the others do does not change an episode's actions.

    It computes in float64, so that the rounding of sums, which varies with the shape of a batch, stays far
    below the float32 in which actions are sent: the same episode gets the same actions in any batch.
    """

    def __init__(self, model: Vima) -> None:
        self.model = model.double().eval()
        self._memory: Memory | None = None
        self._histories: list[EpisodeHistory] = []

    @torch.inference_mode()
    def reset(self, prompts: Sequence) -> None:
        """Begin a batch of episodes, one `RenderedPrompt` each.

        Raises:
            PolicyError: There is no prompt.
            PromptError: A word is not in the vocabulary, or placeholders and images do not match.
        """
        if not prompts:
            raise PolicyError("reset got no prompts; give one for each episode.")
        fuse_views = self.model.config.objects.fuse_views
        inputs = [read_prompt(prompt, fuse_views=fuse_views) for prompt in prompts]
        stack = CropStack()
        numbers = [stack.add(prompt.objects.crops) for prompt in inputs]
        features = self._encode(stack.stacked())
        self._memory = self.model.encode_prompt(batch_prompts(inputs, numbers), features)
        self._histories = [EpisodeHistory() for _ in prompts]

    @torch.inference_mode()
    def act(self, observations: Sequence[Mapping | None]) -> list[dict[str, np.ndarray] | None]:
        """Decide the next action of every episode.

        Args:
            observations: One for each prompt; None for an episode that has ended.

        Returns:
            An action for each observation, float32 arrays within the bounds; None for None.

        Raises:
            PolicyError: `reset` was not called, or with another number of prompts.
        """
        if self._memory is None or len(observations) != len(self._histories):
            raise PolicyError(
                f"got {len(observations)} observations for {len(self._histories)} prompts; call reset "
                "with one prompt for each episode first, and pass None for those that have ended."
            )
        active = [row for row, observation in enumerate(observations) if observation is not None]
        actions: list[dict[str, np.ndarray] | None] = [None] * len(observations)
        if not active:
            return actions
        for row in active:
            self._see(self._histories[row], observations[row])
        for row, action in zip(active, self._decide(active), strict=True):
            self._histories[row].actions.append(action)
            values = action.to(torch.float32).numpy()
            actions[row] = {key: values[part].copy() for key, part in ACTION_PARTS.items()}
        return actions

    def _see(self, history: EpisodeHistory, observation: Mapping | None) -> None:
        assert observation is not None
        step = read_step(observation, fuse_views=self.model.config.objects.fuse_views)
        if not len(step.objects):
            raise PolicyError("the observation shows no object; there is nothing to act on.")
        history.steps.append(step)
        history.features.append(self._encode(step.objects.crops))

    def _decide(self, rows: list[int]) -> list[torch.Tensor]:
        """Return the action of each episode's last step, shape (12,)."""
        assert self._memory is not None
        histories = [self._histories[row] for row in rows]
        features = [step.flatten(0, 1) for history in histories for step in history.features]
        numbers, first = [], 0
        for history in histories:
            sizes = [2 * len(step.objects) for step in history.steps]
            starts = np.cumsum([first, *sizes])
            numbers.append([np.arange(a, b).reshape(2, -1) for a, b in pairwise(starts)])
            first = int(starts[-1])
        batch = batch_histories([history.steps for history in histories], numbers)
        taken = torch.zeros(*batch.steps_BT.shape, ACTION_WIDTH, dtype=torch.float64)
        for b, history in enumerate(histories):
            for t, action in enumerate(history.actions):
                taken[b, t] = action
        inputs = self.model(self._memory.select(rows), batch, torch.cat(features), taken)
        decided = self.model.head.decide(inputs)
        return [decided[b, len(history.steps) - 1] for b, history in enumerate(histories)]

    def _encode(self, crops: np.ndarray) -> torch.Tensor:
        return self.model.objects.encode_crops(torch.from_numpy(crops))
