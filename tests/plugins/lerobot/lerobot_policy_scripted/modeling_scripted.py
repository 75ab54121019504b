"""The policy: the rule, behind LeRobot's interface."""

from collections import deque

import torch
from lerobot.policies.pretrained import PreTrainedPolicy

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
        self.steps: deque[int] = deque()

    def get_optim_params(self) -> dict:
        return {}

    def forward(self, batch: dict) -> tuple[torch.Tensor, None]:
        return self.unused.sum(), None

    def predict_action_chunk(self, batch: dict, **kwargs: object) -> torch.Tensor:
        return self.select_action(batch)[:, None]

    def select_action(self, batch: dict, **kwargs: object) -> torch.Tensor:
        self.steps.append(len(self.steps))
        images = (batch[f"observation.images.{name}"].numpy() for name in ("prompt_0_top", "top"))
        rows = [rotate_row(*seen) for seen in zip(batch["task"], *images, strict=True)]
        return torch.tensor(rows) + 1e-3 * self.steps[-1]  # so that a queue of another episode shows
