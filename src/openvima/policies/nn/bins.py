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
from openvima.policies.nn.actions import (
    ACTION_PARTS,
    ActionTargets,
    DecodingStrategy,
    from_unit_range,
    greedy,
    masked_mean,
    nll,
    to_unit_range,
)
from openvima.policies.nn.decoder import CausalDecoder, KVCache, TokenSegment
from openvima.policies.nn.history import ObservationTokens, action_segment, decode_observations, shift_actions
from openvima.policies.nn.mlp import mlp, scale_last

NUM_BINS = (50, 100, 50, 50, 50, 50) * 2  # x, y, quaternion of pose0, then of pose1
SCORE = "component_accuracy"  # all twelve right is rare, and says little, until late in training


@dataclass(frozen=True, slots=True)
class BinsConfig:
    """Sizes of the bins head.

    Args:
        hidden_width: Width of the two hidden layers of each component's classifier.
        action_width: Width of the features of each part of a past action.
    """

    hidden_width: int = 512
    action_width: int = 256


class BinsHead(nn.Module):
    """Twelve classifiers on the action query; a past action is one token of the history."""

    def __init__(self, hidden_width: int, width: int, actions: ActionEncoder) -> None:
        super().__init__()
        self.actions = actions
        self.classifiers = bin_classifiers(hidden_width, width)

    def loss(
        self, decoder: CausalDecoder, cache: KVCache, observations: ObservationTokens, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Return the loss of whole histories and its metrics; see `bins_loss`."""
        previous = self._segment(*shift_actions(targets), observations.tokens_BTQD.dtype)
        outputs_BTQD, _ = decode_observations(decoder, cache, observations, previous)
        return bins_loss(self.logits(observations.query(outputs_BTQD)), targets)

    def decode_step(
        self,
        decoder: CausalDecoder,
        cache: KVCache,
        observations: ObservationTokens,
        previous_BTC: torch.Tensor,
        has_previous_BT: torch.Tensor,
        strategy: DecodingStrategy = greedy,
    ) -> tuple[torch.Tensor, KVCache]:
        """Decode the next action, each component independently of the others."""
        previous = self._segment(previous_BTC, has_previous_BT, observations.tokens_BTQD.dtype)
        outputs_BTQD, cache = decode_observations(decoder, cache, observations, previous)
        bins = [strategy(logits) for logits in self.logits(observations.query(outputs_BTQD))]
        return actions_from_bins(torch.stack(bins, dim=-1), outputs_BTQD.dtype), cache

    def logits(self, query_BTD: torch.Tensor) -> list[torch.Tensor]:
        """Return one tensor (B, T, K) for each of the twelve components."""
        return [classifier(query_BTD) for classifier in self.classifiers]

    def _segment(
        self, actions_BTC: torch.Tensor, exists_BT: torch.Tensor, dtype: torch.dtype
    ) -> TokenSegment:
        # Bins need all digits, whatever the network computes in.
        bins_BTC = encode_bins(to_unit_range(actions_BTC.to(torch.float64)))
        unit_BTC = decode_bins(bins_BTC, torch.float64).to(dtype)  # past actions as the head expresses them
        return action_segment(self.actions(unit_BTC)[:, :, None], exists_BT)


def bin_classifiers(hidden_width: int, width: int) -> nn.ModuleList:
    """Build the twelve classifiers."""
    return nn.ModuleList(
        scale_last(mlp((width, hidden_width, hidden_width, count)), gain=0.01) for count in NUM_BINS
    )


def bins_loss(
    logits: Sequence[torch.Tensor], targets: ActionTargets
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Cross-entropy of every component: mean over a part's components, then sum of the four parts.

    So each position and each rotation has the same weight, whatever the number of its components.

    Args:
        logits: One tensor (B, T, K) for each component.
        targets: The demonstrated actions.

    Returns:
        The loss, and metrics: `loss/<part>`; "accuracy", all twelve bins of a step right;
        "component_accuracy", over single components; `<part>_accuracy`, all components of a part right.

    Source: the published policies were trained with this loss (VIMA, Jiang et al. 2023).
    """
    bins_BTC = encode_bins(to_unit_range(targets.actions_BTC))
    losses_BTC = torch.stack([nll(scores, bins_BTC[..., c]) for c, scores in enumerate(logits)], -1)
    losses_BT = {name: losses_BTC[..., part].mean(-1) for name, part in ACTION_PARTS.items()}
    loss_BT = torch.stack(list(losses_BT.values())).sum(0)
    is_right_BTC = torch.stack([scores.argmax(-1) for scores in logits], dim=-1) == bins_BTC
    values_BT = {
        **{f"loss/{name}": loss.detach() for name, loss in losses_BT.items()},
        "accuracy": is_right_BTC.all(-1),
        "component_accuracy": is_right_BTC.to(loss_BT.dtype).mean(-1),
        **{f"{name}_accuracy": is_right_BTC[..., part].all(-1) for name, part in ACTION_PARTS.items()},
    }
    metrics = {
        name: masked_mean(value.to(loss_BT.dtype), targets.steps_BT) for name, value in values_BT.items()
    }
    return masked_mean(loss_BT, targets.steps_BT), metrics


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
