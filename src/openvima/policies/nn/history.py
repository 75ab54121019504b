"""The token sequence of a history: observations and actions in turn.

    [obs, obs, query, action, obs, obs, query, action, …]

Shape suffixes: B batch, T steps, Q tokens of a step, D width, C components of an action.
"""

from dataclasses import dataclass

import torch
from torch.nn import functional as F

from openvima.policies.nn.actions import ActionTargets
from openvima.policies.nn.decoder import CausalDecoder, KVCache, TokenSegment


@dataclass(frozen=True, slots=True, eq=False)
class ObservationTokens:
    """Tokens of the observation of every step.

    Args:
        tokens_BTQD: Image tokens, and a learned query behind them if the model has one.
        mask_BTQ: Which of them exist.
        query_BT: Index of the token from whose output the action is decoded; it may be padding.
        steps_BT: Which steps exist.
    """

    tokens_BTQD: torch.Tensor
    mask_BTQ: torch.Tensor
    query_BT: torch.Tensor
    steps_BT: torch.Tensor

    def segment(self) -> TokenSegment:
        """Return them as a segment of the sequence."""
        is_query_BTQ = F.one_hot(self.query_BT, self.mask_BTQ.shape[-1]).bool() & self.steps_BT[..., None]
        return TokenSegment(self.tokens_BTQD, self.mask_BTQ, self.mask_BTQ | is_query_BTQ)

    def query(self, outputs_BTQD: torch.Tensor) -> torch.Tensor:
        """Return the outputs from which actions are decoded, (B, T, D)."""
        index_BT1D = self.query_BT[..., None, None].expand(-1, -1, 1, outputs_BTQD.shape[-1])
        return outputs_BTQD.gather(2, index_BT1D).squeeze(2)


def action_segment(tokens_BTQD: torch.Tensor, exists_BT: torch.Tensor) -> TokenSegment:
    """Return the tokens of actions as a segment of the sequence."""
    mask_BTQ = exists_BT[..., None].expand(tokens_BTQD.shape[:3])
    return TokenSegment(tokens_BTQD, mask_BTQ, mask_BTQ)


def shift_actions(targets: ActionTargets) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the action before each step, (B, T, C), zero before the first; and whether there is one."""
    actions_BTC = targets.actions_BTC
    previous_BTC = torch.cat([torch.zeros_like(actions_BTC[:, :1]), actions_BTC[:, :-1]], dim=1)
    return previous_BTC, F.pad(targets.steps_BT[:, 1:], (1, 0), value=False)


def decode_observations(
    decoder: CausalDecoder, cache: KVCache, observations: ObservationTokens, previous: TokenSegment
) -> tuple[torch.Tensor, KVCache]:
    """Decode steps of a previous action and an observation each.

    Returns:
        The outputs of the observations, (B, T, Q, D), and the cache.
    """
    segments = [previous, observations.segment()]
    (_, outputs_BTQD), cache = decoder.decode_segments(cache, segments)
    return outputs_BTQD, cache
