"""The published action head: every component of an action is a classification over bins.

Encoding and decoding are not inverse to each other: values are compared with n boundaries 1/(n - 1) apart,
but bin k means k/n. All published weights were trained with that.
"""

from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.heads.base import (
    ACTION_PARTS,
    ActionHead,
    ActionTargets,
    Choose,
    HeadInputs,
    from_unit_range,
    likeliest,
    masked_mean,
    to_unit_range,
)
from openvima.policies.layers.mlp import mlp, scale_last

NUM_BINS = (50, 100, 50, 50, 50, 50) * 2  # x, y, quaternion of pose0, then of pose1


@dataclass(frozen=True, slots=True)
class BinsConfig:
    """Sizes of the bins head.

    Args:
        hidden_width: Width of the two hidden layers of each component's classifier.
    """

    hidden_width: int = 512


class BinsHead(ActionHead):
    """Twelve classifiers on the action query; the likeliest bin of each makes the action."""

    def __init__(self, config: BinsConfig, width: int) -> None:
        super().__init__()
        hidden = config.hidden_width
        self.classifiers = nn.ModuleList(
            scale_last(mlp((width, hidden, hidden, count)), gain=0.01) for count in NUM_BINS
        )

    def logits(self, query_BTD: torch.Tensor) -> list[torch.Tensor]:
        """Return one tensor (B, T, bins) for each of the twelve components."""
        return [classifier(query_BTD) for classifier in self.classifiers]

    def loss(
        self, inputs: HeadInputs, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Cross-entropy of every component; each position and each rotation counts alike."""
        bins_BTC = encode_bins(to_unit_range(targets.actions_BTC))
        logits = self.logits(inputs.query_BTD)
        losses, hits = [], []
        for component, scores in enumerate(logits):
            target = bins_BTC[..., component]
            losses.append(
                F.cross_entropy(scores.flatten(0, 1), target.flatten(), reduction="none").view_as(target)
            )
            hits.append(scores.argmax(-1) == target)
        parts = [torch.stack(losses[part]).mean(0) for part in ACTION_PARTS.values()]
        all_hit = torch.stack(hits).to(parts[0].dtype).mean(0)
        accuracy = masked_mean(all_hit, targets.steps_BT)
        return masked_mean(torch.stack(parts).sum(0), targets.steps_BT), {"accuracy": accuracy}

    def decide(self, inputs: HeadInputs, choose: Choose = likeliest) -> torch.Tensor:
        """Choose a bin for each component, independently of the others."""
        bins = torch.stack([choose(scores) for scores in self.logits(inputs.query_BTD)], dim=-1)
        return from_unit_range(decode_bins(bins, inputs.query_BTD.dtype))

    def as_history(self, unit_actions: torch.Tensor) -> torch.Tensor:
        """Return what the bins of the actions decode to."""
        return decode_bins(encode_bins(unit_actions), unit_actions.dtype)


def encode_bins(unit_actions: torch.Tensor) -> torch.Tensor:
    """Map values in 0 … 1, shape (..., 12), to bins, int64; values outside go to the first or last bin."""
    bins = []
    for component, count in enumerate(NUM_BINS):
        boundaries = torch.linspace(0, 1, count, dtype=torch.float32, device=unit_actions.device)
        values = unit_actions[..., component].to(torch.float32).contiguous()
        bins.append(torch.bucketize(values, boundaries).clamp(max=count - 1))
    return torch.stack(bins, dim=-1)


def decode_bins(bins: torch.Tensor, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """Map bins, shape (..., 12), to values in 0 … 1."""
    return bins.to(dtype) / torch.tensor(NUM_BINS, dtype=dtype, device=bins.device)
