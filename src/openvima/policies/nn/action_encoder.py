"""Encoder of past actions."""

import torch
from torch import nn

from openvima.policies.nn.mlp import mlp

# Slices of the action vector: positions and quaternions of both poses, in this order in all policies.
ACTION_PARTS = {
    "pose0_position": slice(0, 2),
    "pose0_rotation": slice(2, 6),
    "pose1_position": slice(6, 8),
    "pose1_rotation": slice(8, 12),
}
ACTION_WIDTH = 12


class ActionEncoder(nn.Module):
    """A past action -> one token: an MLP for each of its four parts, then a linear layer."""

    def __init__(self, part_width: int, width: int) -> None:
        super().__init__()
        sizes = [part.stop - part.start for part in ACTION_PARTS.values()]
        self.parts = nn.ModuleList(mlp((size, part_width, part_width)) for size in sizes)
        self.out = nn.Linear(len(sizes) * part_width, width)

    def forward(self, unit_actions: torch.Tensor) -> torch.Tensor:
        """Map actions in unit range, shape (..., 12), to tokens (..., D)."""
        slices = ACTION_PARTS.values()
        parts = [layers(unit_actions[..., part]) for layers, part in zip(self.parts, slices, strict=True)]
        return self.out(torch.cat(parts, dim=-1))
