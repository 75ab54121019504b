"""Autoregressive action decoding: each action component is conditioned on those before it.

Where two actions would be right, independent components may mix them; here the first component decides.

Shape suffixes: B batch, T steps, Q tokens of a step, D width, C components of an action, K bins of one.

Source: MIDAS (Li et al. 2023).
"""

from dataclasses import dataclass

import torch
from torch import nn

from openvima.errors import ConfigError
from openvima.policies.nn.action_head import ActionLoss, spread
from openvima.policies.nn.actions import ACTION_WIDTH, ActionTargets, DecodingStrategy, greedy, to_unit_range
from openvima.policies.nn.bins import (
    NUM_BINS,
    actions_from_bins,
    bin_classifiers,
    bins_loss,
    encode_bins,
    fit_bins,
)
from openvima.policies.nn.decoder import CausalDecoder, KVCache, TokenSegment
from openvima.policies.nn.history import ObservationTokens, action_segment, decode_observations


@dataclass(frozen=True, slots=True)
class AutoregressiveConfig:
    """Sizes of the autoregressive head.

    Args:
        hidden_width: Width of the two hidden layers of each component's classifier.
        token_std: Standard deviation of the fresh vectors of the bins.
        action_width: `BinsConfig.action_width` of the same network with independent bins; unused here.
    """

    hidden_width: int = 512
    token_std: float = 0.02
    action_width: int = 256

    def __post_init__(self) -> None:
        if self.token_std <= 0:
            raise ConfigError(f"autoregressive head: token_std is {self.token_std}; it must be above 0.")


class AutoregressiveHead(nn.Module):
    """Twelve classifiers, each on the output of the token before its component.

    [..., query,  x0,  y0, a0, b0, c0, d0,  x1,  y1, a1, b1, c1, d1, next step ...]
            |     |    |   |   |   |   |    |    |   |   |   |
            x0    y0   a0  b0  c0  d0  x1   y1   a1  b1  c1  d1
    """

    def __init__(self, hidden_width: int, width: int, actions: "ComponentTokens") -> None:
        super().__init__()
        self.actions = actions
        self.classifiers = bin_classifiers(hidden_width, width)

    def fit_prior(self, actions_NC: torch.Tensor) -> None:
        """Start from the marginal distribution of these actions; see `fit_bins`."""
        fit_bins(self.classifiers, actions_NC)

    def loss(
        self, decoder: CausalDecoder, cache: KVCache, observations: ObservationTokens, targets: ActionTargets
    ) -> ActionLoss:
        """Return the loss of whole histories, with teacher forcing also within an action; see `bins_loss`.

        So the actions returned are more accurate than those of `decode_step`.
        """
        segments = [observations.segment(), self._segment(targets.actions_BTC, targets.steps_BT)]
        (outputs_BTQD, actions_BTCD), _ = decoder.decode_segments(cache, segments)
        query_BT1D = observations.query(outputs_BTQD)[:, :, None]
        outputs_BTCD = torch.cat([query_BT1D, actions_BTCD[:, :, :-1]], dim=2)
        pairs = zip(self.classifiers, outputs_BTCD.unbind(2), strict=True)
        logits = [classifier(output) for classifier, output in pairs]
        loss, metrics, bins_BTC = bins_loss(logits, targets)
        metrics["query_spread"] = spread(query_BT1D.squeeze(2), targets.steps_BT)
        return loss, metrics, actions_from_bins(bins_BTC, outputs_BTQD.dtype)

    def decode_step(
        self,
        decoder: CausalDecoder,
        cache: KVCache,
        observations: ObservationTokens,
        previous_BTC: torch.Tensor,
        has_previous_BT: torch.Tensor,
        strategy: DecodingStrategy = greedy,
    ) -> tuple[torch.Tensor, KVCache]:
        """Decode the next action autoregressively.

        The returned cache ends with the observation: the action joins it with the next one, as it was sent.
        """
        previous = self._segment(previous_BTC, has_previous_BT)
        outputs_BTQD, cache = decode_observations(decoder, cache, observations, previous)
        output_BTD, ahead, bins = observations.query(outputs_BTQD), cache, []
        for component, classifier in enumerate(self.classifiers):
            bins.append(strategy(classifier(output_BTD)))
            if component + 1 < ACTION_WIDTH:
                token_BTD = self.actions.embed(component, bins[-1])
                output_BTD, ahead = decoder(ahead, token_BTD, torch.ones_like(bins[-1], dtype=torch.bool))
        return actions_from_bins(torch.stack(bins, dim=-1), outputs_BTQD.dtype), cache

    def _segment(self, actions_BTC: torch.Tensor, exists_BT: torch.Tensor) -> TokenSegment:
        # Bins need all digits, whatever the network computes in.
        return action_segment(self.actions(to_unit_range(actions_BTC.to(torch.float64))), exists_BT)


class ComponentTokens(nn.Module):
    """A past action -> twelve tokens, one per component: a learned vector for each of its bins."""

    offsets: torch.Tensor

    def __init__(self, width: int, std: float) -> None:
        super().__init__()
        self.bins = nn.Embedding(sum(NUM_BINS), width)
        nn.init.normal_(self.bins.weight, std=std)
        offsets = [sum(NUM_BINS[:component]) for component in range(ACTION_WIDTH)]
        # A constant has a device of its own, so that a network on the meta device has it, too.
        self.register_buffer("offsets", torch.tensor(offsets, device="cpu"), persistent=False)

    def forward(self, unit_actions: torch.Tensor) -> torch.Tensor:
        """Map actions in unit range, shape (..., 12), to tokens (..., 12, D)."""
        return self.bins(encode_bins(unit_actions) + self.offsets)

    def embed(self, component: int, bins: torch.Tensor) -> torch.Tensor:
        """Map bins of one component, int64, any shape, to tokens (..., D)."""
        return self.bins(bins + self.offsets[component])
