"""The published action head: every component of an action is a classification over bins.

Encoding and decoding are not inverse to each other: values are compared with n boundaries 1/(n - 1) apart,
but bin k means k/n. All published weights were trained with that.

Shape suffixes as in `base.py`; C components of an action, K bins of one.
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
    ReadOn,
    from_unit_range,
    likeliest,
    masked_mean,
    to_unit_range,
)
from openvima.policies.nn.mlp import mlp, scale_last

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

    score = "component_accuracy"  # all twelve right is rare, and says little, until late in training

    def __init__(self, config: BinsConfig, width: int) -> None:
        super().__init__()
        hidden = config.hidden_width
        self.classifiers = nn.ModuleList(
            scale_last(mlp((width, hidden, hidden, count)), gain=0.01) for count in NUM_BINS
        )

    def logits(self, query_BTD: torch.Tensor) -> list[torch.Tensor]:
        """Return one tensor (B, T, bins) for each of the twelve components."""
        return [classifier(query_BTD) for classifier in self.classifiers]

    def scores(self, inputs: HeadInputs) -> list[torch.Tensor]:
        """Return the scores that the loss compares with what was done."""
        return self.logits(inputs.query_BTD)

    def loss(
        self, inputs: HeadInputs, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Cross-entropy of every component: mean over a part's components, then sum of the four parts.

        So each position and each rotation counts alike, whatever the number of its components.

        Returns:
            The loss, and shares of right bins: "accuracy", all twelve of a step right;
            "component_accuracy", over single components; and for each part all of its components right.

        Source: the published policies were trained with this loss (VIMA, Jiang et al. 2023).
        """
        bins_BTC = encode_bins(to_unit_range(targets.actions_BTC))
        logits = self.scores(inputs)
        losses_BTC = torch.stack([_surprise(scores, bins_BTC[..., c]) for c, scores in enumerate(logits)], -1)
        loss_BT = torch.stack([losses_BTC[..., part].mean(-1) for part in ACTION_PARTS.values()]).sum(0)
        right_BTC = torch.stack([scores.argmax(-1) for scores in logits], dim=-1) == bins_BTC
        shares_BT = {
            "accuracy": right_BTC.all(-1),
            "component_accuracy": right_BTC.to(loss_BT.dtype).mean(-1),
            **{f"{name}_accuracy": right_BTC[..., part].all(-1) for name, part in ACTION_PARTS.items()},
        }
        steps_BT = targets.steps_BT
        metrics = {name: masked_mean(share.to(loss_BT.dtype), steps_BT) for name, share in shares_BT.items()}
        return masked_mean(loss_BT, steps_BT), metrics

    def decide(
        self, inputs: HeadInputs, choose: Choose = likeliest, read_on: ReadOn | None = None
    ) -> torch.Tensor:
        """Choose a bin for each component, independently of the others."""
        bins = torch.stack([choose(scores) for scores in self.logits(inputs.query_BTD)], dim=-1)
        return from_unit_range(decode_bins(bins, inputs.positions_BTN2.dtype))

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


def _surprise(scores_BTK: torch.Tensor, bins_BT: torch.Tensor) -> torch.Tensor:
    """Negative log-likelihood of the bins, shape (B, T)."""
    return F.cross_entropy(scores_BTK.flatten(0, 1), bins_BT.flatten(), reduction="none").view_as(bins_BT)
