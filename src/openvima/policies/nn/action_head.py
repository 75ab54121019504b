"""Action heads that decode an action from the output of one token a step.

Shape suffixes: B batch, T steps, Q tokens of a step, D width, C components of an action.
"""

import torch
from torch import nn

from openvima.policies.nn.action_encoder import ActionEncoder
from openvima.policies.nn.actions import ActionTargets, DecodingStrategy, greedy, to_unit_range
from openvima.policies.nn.decoder import CausalDecoder, KVCache, TokenSegment
from openvima.policies.nn.history import ObservationTokens, action_segment, decode_observations, shift_actions

# The loss, a mean over all steps; its parts as `loss/<name>`; and the decoded actions, (B, T, C).
ActionLoss = tuple[torch.Tensor, dict[str, torch.Tensor], torch.Tensor]


class ActionHead(nn.Module):
    """Decodes each step's action from its query; a past action is one token of the history.

    A head defines `action_loss`, `action` and `fit_prior`.
    """

    def __init__(self, actions: ActionEncoder) -> None:
        super().__init__()
        self.actions = actions

    def action_loss(self, query_BTD: torch.Tensor, targets: ActionTargets) -> ActionLoss:
        """Return the loss of the demonstrated actions, its parts, and what would be done instead."""
        raise NotImplementedError

    def action(self, query_BTD: torch.Tensor, strategy: DecodingStrategy) -> torch.Tensor:
        """Return actions in metres and quaternions, (B, T, C), within bounds."""
        raise NotImplementedError

    def fit_prior(self, actions_NC: torch.Tensor) -> None:
        """Set the biases of the fresh output layer by the distribution of demonstrated actions (N, 12)."""
        raise NotImplementedError

    def past_actions(self, actions_BTC: torch.Tensor) -> torch.Tensor:
        """Map past actions to unit range, as the head expresses them; float64."""
        return to_unit_range(actions_BTC.to(torch.float64))

    def loss(
        self, decoder: CausalDecoder, cache: KVCache, observations: ObservationTokens, targets: ActionTargets
    ) -> ActionLoss:
        """Return the loss of whole histories; see `action_loss`. `query_spread` is one of the metrics."""
        previous = self._segment(*shift_actions(targets), observations.tokens_BTQD.dtype)
        outputs_BTQD, _ = decode_observations(decoder, cache, observations, previous)
        query_BTD = observations.query(outputs_BTQD)
        loss, metrics, actions_BTC = self.action_loss(query_BTD, targets)
        return loss, {**metrics, "query_spread": spread(query_BTD, targets.steps_BT)}, actions_BTC

    def decode_step(
        self,
        decoder: CausalDecoder,
        cache: KVCache,
        observations: ObservationTokens,
        previous_BTC: torch.Tensor,
        has_previous_BT: torch.Tensor,
        strategy: DecodingStrategy = greedy,
    ) -> tuple[torch.Tensor, KVCache]:
        """Decode the next action."""
        previous = self._segment(previous_BTC, has_previous_BT, observations.tokens_BTQD.dtype)
        outputs_BTQD, cache = decode_observations(decoder, cache, observations, previous)
        return self.action(observations.query(outputs_BTQD), strategy), cache

    def _segment(
        self, actions_BTC: torch.Tensor, exists_BT: torch.Tensor, dtype: torch.dtype
    ) -> TokenSegment:
        return action_segment(self.actions(self.past_actions(actions_BTC).to(dtype))[:, :, None], exists_BT)


@torch.no_grad()
def spread(query_BTD: torch.Tensor, steps_BT: torch.Tensor) -> torch.Tensor:
    """Return the standard deviation of action queries over a batch, by their root mean square.

    Where it is near 0, all inputs give the same action: the decoder has collapsed.
    """
    query_ND = query_BTD[steps_BT]
    return query_ND.std(dim=0, correction=0).square().mean().sqrt() / query_ND.square().mean().sqrt()
