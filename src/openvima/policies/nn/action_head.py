"""The token sequence of a history, and the published action head on it.

    [obs, obs, query, action, obs, obs, query, action, …]

Every action component is a classification over bins. Encoding and decoding are not inverse to each other:
values are compared with n boundaries 1/(n - 1) apart, but bin k decodes to k/n. All published weights were
trained with that.

Shape suffixes: B batch, T steps, Q tokens of a step, D width, C components of an action, K bins of one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.nn.actions import (
    ACTION_PARTS,
    ACTION_WIDTH,
    PLACE_NEAR_M,
    ActionTargets,
    DecodingStrategy,
    at,
    from_unit_range,
    greedy,
    mask_scores,
    masked_mean,
    nll,
    to_unit_range,
)
from openvima.policies.nn.decoder import CausalDecoder, KVCache, TokenSegment
from openvima.policies.nn.layers import layer_of, mlp


@dataclass(frozen=True, slots=True, eq=False)
class ObservationTokens:
    """Tokens of the observation of every step.

    Args:
        tokens_BTQD: Image tokens, and a learned query behind them if the model has one.
        mask_BTQ: Which of them exist.
        query_BT: Index of the token from whose output the action is decoded; it may be padding.
        steps_BT: Which steps exist.
        points_BTQ2: Table points of the objects in the top view that tokens stand for, metres; infinite for
            other tokens. None where positions are not read from objects.
        grasps_BTQ2: As `points_BTQ2`, under the most interior pixels in place of the boxes' centres.
        scene_tokens_BLD: Tokens of other scenes that places may be in: the prompt's, and the first step.
        scene_points_BL2: Table points of the objects in these that they stand for; infinite for others.
    """

    tokens_BTQD: torch.Tensor
    mask_BTQ: torch.Tensor
    query_BT: torch.Tensor
    steps_BT: torch.Tensor
    points_BTQ2: torch.Tensor | None = None
    grasps_BTQ2: torch.Tensor | None = None
    scene_tokens_BLD: torch.Tensor | None = None
    scene_points_BL2: torch.Tensor | None = None

    def candidates(self, half: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Return tokens (B, T, Q', D) and points (B, T, Q', 2) to pick, half 0, or to place at, half 1."""
        own = cast(torch.Tensor, self.points_BTQ2)
        if half == 0:
            return self.tokens_BTQD, own
        pairs = (self.tokens_BTQD, self.scene_tokens_BLD), (own, self.scene_points_BL2)
        tokens, points = (
            torch.cat([each, cast(torch.Tensor, others)[:, None].expand(-1, each.shape[1], -1, -1)], dim=2)
            for each, others in pairs
        )
        return tokens, points

    def segment(self) -> TokenSegment:
        """Return them as a segment of the sequence."""
        is_query_BTQ = F.one_hot(self.query_BT, self.mask_BTQ.shape[-1]).bool() & self.steps_BT[..., None]
        return TokenSegment(self.tokens_BTQD, self.mask_BTQ, self.mask_BTQ | is_query_BTQ)

    def query(self, outputs_BTQD: torch.Tensor) -> torch.Tensor:
        """Return the outputs from which actions are decoded, (B, T, D)."""
        return at(outputs_BTQD, self.query_BT)


def action_segment(tokens_BTQD: torch.Tensor, exists_BT: torch.Tensor) -> TokenSegment:
    """Return the tokens of actions as a segment of the sequence."""
    mask_BTQ = exists_BT[..., None].expand(tokens_BTQD.shape[:3])
    return TokenSegment(tokens_BTQD, mask_BTQ, mask_BTQ)


def shift_actions(targets: ActionTargets) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the action before each step, (B, T, C), zero before the first; and whether there is one."""
    actions_BTC = targets.actions_BTC
    previous_BTC = torch.cat([torch.zeros_like(actions_BTC[:, :1]), actions_BTC[:, :-1]], dim=1)
    return previous_BTC, F.pad(targets.steps_BT[:, 1:], (1, 0), value=False)


_POSITIONS = (ACTION_PARTS["pose0_position"], ACTION_PARTS["pose1_position"])
_SAME_M = 0.01  # objects that near have one position
# The loss, a mean over all steps; its parts as `loss/<name>`; and the decoded actions, (B, T, C).
ActionLoss = tuple[torch.Tensor, dict[str, torch.Tensor], torch.Tensor]


class ActionHead(nn.Module):
    """Decodes each step's action from its query; a past action is one token of the history.

    A head defines `action_loss`, `action` and `fit_prior`.

    Args:
        actions: Encodes past actions as tokens.

    Attributes:
        points: Whether positions are read from objects, as `pointing_loss` trains it; see `point_at_objects`.
    """

    actions: Any  # `ActionEncoder`, or `ComponentTokens` of the autoregressive head
    points = False

    def __init__(self, actions: nn.Module) -> None:
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
        previous = self.segment(*shift_actions(targets), observations.tokens_BTQD.dtype)
        (_, outputs_BTQD), _ = decoder.decode_segments(cache, [previous, observations.segment()])
        query_BTD = observations.query(outputs_BTQD)
        found = self.action_loss(query_BTD, targets)
        return self.add_pointing(found, query_BTD, query_BTD, observations, targets)

    def decode(
        self,
        decoder: CausalDecoder,
        cache: KVCache,
        query_BTD: torch.Tensor,
        observations: ObservationTokens,
        strategy: DecodingStrategy,
    ) -> torch.Tensor:
        """Decode the next action from its query, the output at the end of the observation.

        Args:
            decoder: Decodes further tokens, where a head has some.
            cache: Ends with the observation; the action joins it with the next one, as it was sent.
            query_BTD: The query.
            observations: Tokens of the observation.
            strategy: How a class is decoded from logits.
        """
        actions_BTC = self.action(query_BTD, strategy)
        if self.points:
            actions_BTC = point_at_objects(actions_BTC, query_BTD, query_BTD, observations, strategy)
        return actions_BTC

    def add_pointing(
        self,
        found: ActionLoss,
        pick_BTD: torch.Tensor,
        place_BTD: torch.Tensor,
        observations: ObservationTokens,
        targets: ActionTargets,
    ) -> ActionLoss:
        """Add the spread of the queries to the metrics of an action loss.

        Where positions are read from objects, add `pointing_loss`, too, and let the decoded actions point.
        """
        loss, metrics, actions_BTC = found
        metrics = {**metrics, "query_spread": spread(pick_BTD, targets.steps_BT)}
        if self.points:
            pointing = pointing_loss(pick_BTD, place_BTD, observations, targets)
            actions_BTC = point_at_objects(actions_BTC, pick_BTD, place_BTD, observations, greedy)
            loss, metrics["loss/pointing"] = loss + pointing, pointing.detach()
        return loss, metrics, actions_BTC

    def segment(self, actions_BTC: torch.Tensor, exists_BT: torch.Tensor, dtype: torch.dtype) -> TokenSegment:
        """Return past actions as a segment of the sequence, whose tokens have this precision."""
        return action_segment(self.actions(self.past_actions(actions_BTC).to(dtype))[:, :, None], exists_BT)


def pointing_loss(
    pick_BTD: torch.Tensor, place_BTD: torch.Tensor, observations: ObservationTokens, targets: ActionTargets
) -> torch.Tensor:
    """Return the cross-entropy of which objects are picked and placed at.

    Demonstrated picks are random points of an object, which costs bins two nats a coordinate and hides the
    choice of the object in noise; here it is the target itself. The dot product with the first half of each
    object's token scores picks, that with the second half places: no weights are added.

    Args:
        pick_BTD: The output from which the pick is decoded.
        place_BTD: That from which the place is decoded.
        observations: The objects' tokens, as they enter the decoder.
        targets: Demonstrated actions; a place that no object is near counts as one at no object.
    """
    loss = pick_BTD.new_zeros(())
    picked_BT = torch.zeros_like(observations.query_BT)
    for half, query_BTD in enumerate((pick_BTD, place_BTD)):
        scores_BTQ, points_BTQ2 = _score_objects(half, query_BTD, observations, picked_BT)
        if half == 0:  # the centre of a container may be nearer than that of what is picked out of it
            points_BTQ2 = cast(torch.Tensor, observations.grasps_BTQ2)
        target_BT12 = targets.actions_BTC[..., None, _POSITIONS[half]].to(points_BTQ2)
        distance_BTQ = (points_BTQ2 - target_BT12).norm(dim=-1)
        nearest_BT, picked_BT = distance_BTQ.min(dim=-1)
        counts_BT = targets.steps_BT & nearest_BT.isfinite()
        if half == 0:
            is_right_BTQ = distance_BTQ <= nearest_BT[..., None]
        else:  # what lies still is there in other scenes as well: either is right
            is_at_one_BT = nearest_BT < PLACE_NEAR_M
            is_right_BTQ = (distance_BTQ <= nearest_BT[..., None] + _SAME_M) & is_at_one_BT[..., None]
            is_right_BTQ[..., -1] = ~is_at_one_BT
        right_BTQ = scores_BTQ.masked_fill(~is_right_BTQ, -math.inf)
        losses_BT = scores_BTQ.logsumexp(-1) - right_BTQ.logsumexp(-1)
        loss = loss + losses_BT[counts_BT].sum() / targets.steps_BT.sum().clamp(min=1)
    return loss


def point_at_objects(
    actions_BTC: torch.Tensor,
    pick_BTD: torch.Tensor,
    place_BTD: torch.Tensor,
    observations: ObservationTokens,
    strategy: DecodingStrategy,
) -> torch.Tensor:
    """Move picks and places to the centres of the objects that their outputs point at.

    Independent bins of two equally good picks may give the column of one and the row of the other; see
    results/2026-11-28_vima_pointing.md. A place that points at no object stays.
    """
    actions_BTC = actions_BTC.clone()
    picked_BT = torch.zeros_like(observations.query_BT)
    for half, query_BTD in enumerate((pick_BTD, place_BTD)):
        picked_BT = point_at_object(half, actions_BTC, query_BTD, observations, strategy, picked_BT)
    return actions_BTC


def point_at_object(
    half: int,
    actions_BTC: torch.Tensor,
    query_BTD: torch.Tensor,
    observations: ObservationTokens,
    strategy: DecodingStrategy,
    picked_BT: torch.Tensor,
) -> torch.Tensor:
    """Do so in place with the pick, half 0, or the place, half 1; see `point_at_objects`.

    Returns:
        The token that is pointed at; for the place it is to be given as `picked_BT`.
    """
    part = _POSITIONS[half]
    scores_BTQ, points_BTQ2 = _score_objects(half, query_BTD, observations, picked_BT)
    slot_BT = strategy(scores_BTQ)
    point_BT2 = at(points_BTQ2, slot_BT)
    position_BT2 = torch.where(point_BT2.isfinite(), point_BT2, actions_BTC[..., part].to(point_BT2))
    actions_BTC[..., part] = position_BT2.to(actions_BTC.dtype)
    return slot_BT


def _score_objects(
    half: int, query_BTD: torch.Tensor, observations: ObservationTokens, picked_BT: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Score tokens as the object of the pick, half 0, or of the place, half 1; and return their points.

    The score of what is no object is very low. The query of the place is joined by the token of the picked
    object, which its goal may look like; and the last score of places, 0, is that of no object.
    """
    tokens_BTQD, points_BTQ2 = observations.candidates(half)
    if half == 1:
        query_BTD = query_BTD + at(observations.tokens_BTQD, picked_BT)
    query_BTE, keys_BTQE = query_BTD.chunk(2, -1)[half], tokens_BTQD.chunk(2, -1)[half]
    scores_BTQ = torch.einsum("btqe,bte->btq", keys_BTQE, query_BTE) * query_BTE.shape[-1] ** -0.5
    scores_BTQ = mask_scores(scores_BTQ, points_BTQ2[..., 0].isfinite())
    if half == 1:
        scores_BTQ, points_BTQ2 = F.pad(scores_BTQ, (0, 1)), F.pad(points_BTQ2, (0, 0, 0, 1), value=math.inf)
    return scores_BTQ, points_BTQ2


@torch.no_grad()
def spread(query_BTD: torch.Tensor, steps_BT: torch.Tensor) -> torch.Tensor:
    """Return the standard deviation of action queries over a batch, by their root mean square.

    Where it is near 0, all inputs give the same action: the decoder has collapsed.
    """
    query_ND = query_BTD[steps_BT]
    return query_ND.std(dim=0, correction=0).square().mean().sqrt() / query_ND.square().mean().sqrt()


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
    """Twelve classifiers on the action query, each component independent of the others.

    Attributes:
        pointing_indices: Which of the classes that a step decodes are the objects of pick and place, with
            `points`; the others are bins, in order.
    """

    pointing_indices = (ACTION_WIDTH, ACTION_WIDTH + 1)

    def __init__(self, hidden_width: int, width: int, actions: nn.Module) -> None:
        super().__init__(actions)
        hidden = (width, hidden_width, hidden_width)
        self.classifiers = nn.ModuleList(mlp((*hidden, count), last_gain=0.01) for count in NUM_BINS)

    def action_loss(self, query_BTD: torch.Tensor, targets: ActionTargets) -> ActionLoss:
        """Return the loss, its parts and the decoded actions; see `bins_loss`."""
        return bins_loss(self.logits(query_BTD), targets)

    def action(self, query_BTD: torch.Tensor, strategy: DecodingStrategy) -> torch.Tensor:
        """Decode the bin of each component."""
        bins = [strategy(logits) for logits in self.logits(query_BTD)]
        return actions_from_bins(torch.stack(bins, dim=-1), query_BTD.dtype)

    def past_actions(self, actions_BTC: torch.Tensor) -> torch.Tensor:
        """Map past actions to the bins that the head would have given, in unit range; float64."""
        return decode_bins(encode_bins(super().past_actions(actions_BTC)), torch.float64)

    @torch.no_grad()
    def fit_prior(self, actions_NC: torch.Tensor) -> None:
        """Set the biases to the log-frequencies of the bins in these actions, smoothed by a 1% uniform part.

        Uniform classifiers get the same large gradient from every example, which drives post-norm blocks to a
        constant output within the first hundred steps, from which they hardly recover. See
        docs/train_vima.md.
        """
        bins_NC = encode_bins(to_unit_range(actions_NC))
        for component, classifier in enumerate(self.classifiers):
            counts = torch.bincount(bins_NC[:, component], minlength=NUM_BINS[component]).to(torch.float64)
            frequencies = 0.99 * counts / counts.sum() + 0.01 / len(counts)
            layer_of(classifier, -1).bias.copy_(frequencies.log())

    def logits(self, query_BTD: torch.Tensor) -> list[torch.Tensor]:
        """Return one tensor (B, T, K) for each of the twelve components."""
        return [classifier(query_BTD) for classifier in self.classifiers]


def bins_loss(logits: Sequence[torch.Tensor], targets: ActionTargets) -> ActionLoss:
    """Cross-entropy of every component: mean over a part's components, then sum of the four parts.

    So each position and each rotation has the same weight, whatever the number of its components.

    Args:
        logits: One tensor (B, T, K) for each component.
        targets: The demonstrated actions.

    Returns:
        The loss; its parts as `loss/<part>`; and the actions of the bins with the highest logits, (B, T, C).

    Source: the published policies were trained with this loss (VIMA, Jiang et al. 2023).
    """
    bins_BTC = encode_bins(to_unit_range(targets.actions_BTC))
    losses_BTC = torch.stack([nll(scores, bins_BTC[..., c]) for c, scores in enumerate(logits)], -1)
    losses_BT = {name: losses_BTC[..., part].mean(-1) for name, part in ACTION_PARTS.items()}
    loss = masked_mean(torch.stack(list(losses_BT.values())).sum(0), targets.steps_BT)
    metrics = {
        f"loss/{name}": masked_mean(loss_BT.detach(), targets.steps_BT) for name, loss_BT in losses_BT.items()
    }
    best_BTC = torch.stack([scores.argmax(-1) for scores in logits], dim=-1)
    return loss, metrics, actions_from_bins(best_BTC, logits[0].dtype)


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
