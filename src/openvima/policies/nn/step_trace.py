"""What a network computed for one step, to explain its action.

Shape suffixes: B batch, L positions of the prompt, C place candidates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch


@dataclass(frozen=True, slots=True, eq=False)
class StepTrace:
    """Logits and attention of one step.

    Args:
        logits: Of each choice in the order of decoding, (B, classes) each.
        attention: Kind of attention to weights of the prompt's positions, (B, L), which sum to 1.
        positions_BC2: Positions of the place candidates, metres; None without any.
        masks_BC: Which of them exist.
        kinds_C: Kind of each, an index of `PLACE_KINDS`.
    """

    logits: Sequence[torch.Tensor]
    attention: Mapping[str, torch.Tensor]
    positions_BC2: torch.Tensor | None = None
    masks_BC: torch.Tensor | None = None
    kinds_C: torch.Tensor | None = None


class Replay:
    """Decoding strategy that repeats choices, and keeps the logits they were made from.

    Args:
        choices: Class indices in the order of decoding, (B, 1) each.
    """

    def __init__(self, choices: Sequence[torch.Tensor]) -> None:
        self._choices = choices
        self.logits: list[torch.Tensor] = []

    def __call__(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the next choice."""
        self.logits.append(logits[:, 0])
        return self._choices[len(self.logits) - 1]


def normalized(weights_BL: torch.Tensor, mask_BL: torch.Tensor) -> torch.Tensor:
    """Scale weights to a sum of 1; equal ones where nothing has any."""
    weights_BL = weights_BL * mask_BL
    total_B1 = weights_BL.sum(dim=-1, keepdim=True)
    equal_BL = mask_BL / mask_BL.sum(dim=-1, keepdim=True)
    return torch.where(
        total_B1 > 0, weights_BL / total_B1.clamp(min=torch.finfo(total_B1.dtype).tiny), equal_BL
    )
