"""Past actions to tokens."""

import torch
from torch import nn

from openvima.policies.nn.mlp import mlp

# Positions and quaternions of both poses in one vector, in this order, as everywhere in the policies.
ACTION_PARTS = {
    "pose0_position": slice(0, 2),
    "pose0_rotation": slice(2, 6),
    "pose1_position": slice(6, 8),
    "pose1_rotation": slice(8, 12),
}
ACTION_WIDTH = 12


class ActionEncoder(nn.Module):
    """A past action -> one token: a stack for each of its four parts, then one linear layer."""

    def __init__(self, part_width: int, width: int) -> None:
        super().__init__()
        sizes = [part.stop - part.start for part in ACTION_PARTS.values()]
        self.parts = nn.ModuleList(mlp((size, part_width, part_width)) for size in sizes)
        self.out = nn.Linear(len(sizes) * part_width, width)

    def forward(self, unit_actions: torch.Tensor) -> torch.Tensor:
        """Map actions in unit range, shape (..., 12), to tokens (..., D)."""
        places = ACTION_PARTS.values()
        parts = [stack(unit_actions[..., place]) for stack, place in zip(self.parts, places, strict=True)]
        return self.out(torch.cat(parts, dim=-1))
