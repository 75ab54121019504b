"""The published action head: every action component is a classification over bins.

Encoding and decoding are not inverse to each other: values are compared with n boundaries 1/(n - 1) apart,
but bin k decodes to k/n. All published weights were trained with that.

Shape suffixes: B batch, T steps, Q tokens of a step, D width, C components of an action, K bins of one.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import nn

from openvima.policies.nn.action_encoder import ActionEncoder
from openvima.policies.nn.action_head import ActionHead, ActionLoss
from openvima.policies.nn.actions import (
    ACTION_PARTS,
    ActionTargets,
    DecodingStrategy,
    from_unit_range,
    masked_mean,
    nll,
    to_unit_range,
)
from openvima.policies.nn.mlp import layer_of, mlp, scale_last

NUM_BINS = (50, 100, 50, 50, 50, 50) * 2  # x, y, quaternion of pose0, then of pose1


@dataclass(frozen=True, slots=True)
class BinsConfig:
    """Sizes of the bins head.

    Args:
        hidden_width: Width of the two hidden layers of each component's classifier.
        action_width: Width of the features of each part of a past action.
    """

    hidden_width: int = 512
    action_width: int = 256


class BinsHead(ActionHead):
    """Twelve classifiers on the action query, each component independent of the others."""

    def __init__(self, hidden_width: int, width: int, actions: ActionEncoder) -> None:
        super().__init__(actions)
        self.classifiers = bin_classifiers(hidden_width, width)

    def action_loss(self, query_BTD: torch.Tensor, targets: ActionTargets) -> ActionLoss:
        """Return the loss, its parts and the decoded actions; see `bins_loss`."""
        loss, metrics, bins_BTC = bins_loss(self.logits(query_BTD), targets)
        return loss, metrics, actions_from_bins(bins_BTC, query_BTD.dtype)

    def action(self, query_BTD: torch.Tensor, strategy: DecodingStrategy) -> torch.Tensor:
        """Decode the bin of each component."""
        bins = [strategy(logits) for logits in self.logits(query_BTD)]
        return actions_from_bins(torch.stack(bins, dim=-1), query_BTD.dtype)

    def past_actions(self, actions_BTC: torch.Tensor) -> torch.Tensor:
        """Map past actions to the bins that the head would have given, in unit range; float64."""
        return decode_bins(encode_bins(super().past_actions(actions_BTC)), torch.float64)

    def fit_prior(self, actions_NC: torch.Tensor) -> None:
        """Start from the marginal distribution of these actions; see `fit_bins`."""
        fit_bins(self.classifiers, actions_NC)

    def logits(self, query_BTD: torch.Tensor) -> list[torch.Tensor]:
        """Return one tensor (B, T, K) for each of the twelve components."""
        return [classifier(query_BTD) for classifier in self.classifiers]


def bin_classifiers(hidden_width: int, width: int) -> nn.ModuleList:
    """Build the twelve classifiers."""
    return nn.ModuleList(
        scale_last(mlp((width, hidden_width, hidden_width, count)), gain=0.01) for count in NUM_BINS
    )


@torch.no_grad()
def fit_bins(classifiers: nn.ModuleList, actions_NC: torch.Tensor) -> None:
    """Set the biases of fresh classifiers to the log-frequencies of the bins, smoothed by a 1% uniform part.

    Uniform classifiers get the same large gradient from every example, which drives post-norm blocks to a
    constant output within the first hundred steps, from which they hardly recover. See docs/train_vima.md.

    Args:
        classifiers: One for each component.
        actions_NC: Demonstrated actions, metres and quaternions.
    """
    bins_NC = encode_bins(to_unit_range(actions_NC))
    for component, classifier in enumerate(classifiers):
        counts = torch.bincount(bins_NC[:, component], minlength=NUM_BINS[component]).to(torch.float64)
        frequencies = 0.99 * counts / counts.sum() + 0.01 / len(counts)
        layer_of(classifier, -1).bias.copy_(frequencies.log())


def bins_loss(
    logits: Sequence[torch.Tensor], targets: ActionTargets
) -> tuple[torch.Tensor, dict[str, torch.Tensor], torch.Tensor]:
    """Cross-entropy of every component: mean over a part's components, then sum of the four parts.

    So each position and each rotation has the same weight, whatever the number of its components.

    Args:
        logits: One tensor (B, T, K) for each component.
        targets: The demonstrated actions.

    Returns:
        The loss; its parts as `loss/<part>`; and the bins with the highest logits, (B, T, C).

    Source: the published policies were trained with this loss (VIMA, Jiang et al. 2023).
    """
    bins_BTC = encode_bins(to_unit_range(targets.actions_BTC))
    losses_BTC = torch.stack([nll(scores, bins_BTC[..., c]) for c, scores in enumerate(logits)], -1)
    losses_BT = {name: losses_BTC[..., part].mean(-1) for name, part in ACTION_PARTS.items()}
    loss = masked_mean(torch.stack(list(losses_BT.values())).sum(0), targets.steps_BT)
    metrics = {
        f"loss/{name}": masked_mean(loss_BT.detach(), targets.steps_BT) for name, loss_BT in losses_BT.items()
    }
    return loss, metrics, torch.stack([scores.argmax(-1) for scores in logits], dim=-1)


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


def actions_from_bins(bins: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Map bins (..., 12) to actions in metres and quaternions, in float32 at least."""
    return from_unit_range(decode_bins(bins, torch.promote_types(dtype, torch.float32)))
