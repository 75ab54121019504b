"""The policy: the rule, behind LeRobot's interface."""

from collections import deque

import numpy as np
import torch
from lerobot.policies.pretrained import PreTrainedPolicy

from language_rule import commands
from lerobot_policy_scripted.configuration_scripted import ScriptedConfig
from lerobot_policy_scripted.rule import rotate_row


class ScriptedPolicy(PreTrainedPolicy):
    """Counts its steps in a queue, as policies with action chunks keep theirs."""

    config_class = ScriptedConfig
    name = "scripted"

    def __init__(self, config: ScriptedConfig, **kwargs: object) -> None:
        super().__init__(config)
        self.unused = torch.nn.Parameter(torch.zeros(1))
        self.reset()

    def reset(self) -> None:
        self.steps: deque = deque()

    def get_optim_params(self) -> dict:
        return {}

    def forward(self, batch: dict) -> tuple[torch.Tensor, None]:
        return self.unused.sum(), None

    def predict_action_chunk(self, batch: dict, **kwargs: object) -> torch.Tensor:
        return self.select_action(batch)[:, None]

    def select_action(self, batch: dict, **kwargs: object) -> torch.Tensor:
        if self.config.low_level:
            return self._command(batch)
        self.steps.append(len(self.steps))
        images = (batch[f"observation.images.{name}"].numpy() for name in ("prompt_0_top", "top"))
        rows = [rotate_row(*seen) for seen in zip(batch["task"], *images, strict=True)]
        return torch.tensor(rows) + 1e-3 * self.steps[-1]  # so that a queue of another episode shows

    def _command(self, batch: dict) -> torch.Tensor:
        """Decide all commands of an episode at its start, as a chunk; batches of 1."""
        if not self.steps:
            ((text,), (top,)) = batch["task"], batch["observation.images.top"]
            images = {"top": np.moveaxis((255 * top).round().byte().numpy(), 0, -1)}
            self.steps.extend(commands(text, images, batch["observation.state"][0].numpy()))
        return torch.tensor(self.steps.popleft())[None]
