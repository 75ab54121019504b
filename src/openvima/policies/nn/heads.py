"""The other action heads: autoregressive bins, a mixture density, and plain regression; all heads by config.

Autoregressive: each component is conditioned on those before it. Where two actions would be right,
independent components may mix them; here the first component decides. Source: MIDAS (Li et al. 2023).

The continuous heads express an action by six numbers: the planar positions of pick and place in unit range,
and the rotation between them as cosine and sine. Only the difference of the two yaws turns an object, so the
rotation at the pick is none.

Shape suffixes: B batch, T steps, Q tokens of a step, D width, C components of an action, K bins of one, or
components of the mixture.
"""

import math
from dataclasses import dataclass

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.nn.action_head import (
    NUM_BINS,
    ActionHead,
    ActionLoss,
    BinsConfig,
    BinsHead,
    ObservationTokens,
    action_segment,
    actions_from_bins,
    bins_loss,
    encode_bins,
    point_at_object,
)
from openvima.policies.nn.actions import (
    ACTION_PARTS,
    ACTION_WIDTH,
    ActionEncoder,
    ActionTargets,
    DecodingStrategy,
    at,
    from_unit_range,
    greedy,
    masked_mean,
    to_unit_range,
    yaw_between,
)
from openvima.policies.nn.decoder import CausalDecoder, KVCache, TokenSegment
from openvima.policies.nn.layers import layer_of, mlp


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


class AutoregressiveHead(BinsHead):
    """Twelve classifiers, each on the output of the token before its component.

    [..., query,  x0,  y0, a0, b0, c0, d0,  x1,  y1, a1, b1, c1, d1, next step ...]
            |     |    |   |   |   |   |    |    |   |   |   |
            x0    y0   a0  b0  c0  d0  x1   y1   a1  b1  c1  d1
    """

    pointing_indices = (2, 3 + ACTION_WIDTH // 2)  # each after x and y

    def loss(
        self, decoder: CausalDecoder, cache: KVCache, observations: ObservationTokens, targets: ActionTargets
    ) -> ActionLoss:
        """Return the loss of whole histories, with teacher forcing also within an action; see `bins_loss`.

        So the actions returned are more accurate than those of `decode`.
        """
        actions = self.segment(targets.actions_BTC, targets.steps_BT, observations.tokens_BTQD.dtype)
        segments = [observations.segment(), actions]
        (outputs_BTQD, actions_BTCD), _ = decoder.decode_segments(cache, segments)
        query_BT1D = observations.query(outputs_BTQD)[:, :, None]
        outputs_BTCD = torch.cat([query_BT1D, actions_BTCD[:, :, :-1]], dim=2)
        pairs = zip(self.classifiers, outputs_BTCD.unbind(2), strict=True)
        logits = [classifier(output) for classifier, output in pairs]
        found = bins_loss(logits, targets)
        pick_BTD, place_BTD = outputs_BTCD[:, :, 0], outputs_BTCD[:, :, ACTION_WIDTH // 2]
        return self.add_pointing(found, pick_BTD, place_BTD, observations, targets)

    def decode(
        self,
        decoder: CausalDecoder,
        cache: KVCache,
        query_BTD: torch.Tensor,
        observations: ObservationTokens,
        strategy: DecodingStrategy,
    ) -> torch.Tensor:
        """Decode the next action autoregressively.

        A position that is read from an object replaces the decoded one before the next component is decoded.
        """
        output_BTD = query_BTD
        bins_BTC = torch.zeros(
            *output_BTD.shape[:2], ACTION_WIDTH, dtype=torch.int64, device=output_BTD.device
        )
        pointed, before, picked_BT = [], (output_BTD, cache), torch.zeros_like(observations.query_BT)

        def read(component: int) -> None:
            nonlocal output_BTD, cache
            token_BTD = self.actions.embed(component, bins_BTC[..., component])
            exists_BT = torch.ones_like(bins_BTC[..., component], dtype=torch.bool)
            output_BTD, cache = decoder(cache, token_BTD, exists_BT)

        for component, classifier in enumerate(self.classifiers):
            half, place = divmod(component, ACTION_WIDTH // 2)
            if place == 0:
                before = output_BTD, cache
            bins_BTC[..., component] = strategy(classifier(output_BTD))
            if self.points and place == 1:  # the position is complete, and read again if it moves
                actions_BTC = actions_from_bins(bins_BTC, query_BTD.dtype)
                picked_BT = point_at_object(half, actions_BTC, before[0], observations, strategy, picked_BT)
                part = slice(component - 1, component + 1)
                pointed.append((part, actions_BTC[..., part]))
                bins_BTC[..., part] = encode_bins(to_unit_range(actions_BTC.to(torch.float64)))[..., part]
                output_BTD, cache = before
                read(component - 1)
            if component + 1 < ACTION_WIDTH:
                read(component)
        actions_BTC = actions_from_bins(bins_BTC, query_BTD.dtype)
        for part, position_BT2 in pointed:
            actions_BTC[..., part] = position_BT2
        return actions_BTC

    def segment(self, actions_BTC: torch.Tensor, exists_BT: torch.Tensor, dtype: torch.dtype) -> TokenSegment:
        """Return past actions as a segment; bins need all digits, whatever the network computes in."""
        return action_segment(self.actions(to_unit_range(actions_BTC.to(torch.float64))), exists_BT)


_ACTION_GAIN = 8.0  # as `_POSITION_GAIN` of the decoder: image tokens are of the order of 1
_NUM_WAVES = 8


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

    @torch.no_grad()
    def align(self) -> None:
        """Let fresh vectors be smooth over the bins of a component, and as strong as positions and images.

        Those of a component are mixtures of its first few vectors by slow waves over the bins. Otherwise each
        bin learns by itself where it is, and is not heard: see results/2026-11-29_midas_actions.md.
        """
        for vectors_ND in self.bins.weight.split(NUM_BINS):
            wave_N1 = torch.linspace(0, math.pi, len(vectors_ND), device=vectors_ND.device)[:, None]
            waves_NK = torch.cos(wave_N1 * torch.arange(_NUM_WAVES, device=vectors_ND.device))
            gain = _ACTION_GAIN * (2 / (_NUM_WAVES + 1)) ** 0.5
            vectors_ND.copy_(gain * waves_NK @ vectors_ND[:_NUM_WAVES])

    def embed(self, component: int, bins: torch.Tensor) -> torch.Tensor:
        """Map bins of one component, int64, any shape, to tokens (..., D)."""
        return self.bins(bins + self.offsets[component])


_POSITIONS = 4  # x, y of pick and of place


@dataclass(frozen=True, slots=True)
class MixtureConfig:
    """Sizes of the mixture-density head.

    Args:
        hidden_width: Width of the two hidden layers.
        action_width: Width of the features of each part of a past action.
        num_components: Components of the mixture.
        min_std: Smallest standard deviation of a position, in unit range (0.05 is 25 mm in x, 50 mm in y),
            and of the rotation, in radians. It bounds the density, which has no maximum otherwise; with
            0.005 a short training did not learn which component is right. Modes can be more precise.
    """

    hidden_width: int = 512
    action_width: int = 256
    num_components: int = 5
    min_std: float = 0.05


@dataclass(frozen=True, slots=True)
class RegressionConfig:
    """Sizes of the regression head.

    Args:
        hidden_width: Width of the two hidden layers.
        action_width: Width of the features of each part of a past action.
        huber_delta: Error above which the loss grows linearly, in unit range.
    """

    hidden_width: int = 512
    action_width: int = 256
    huber_delta: float = 0.05


class MixtureHead(ActionHead):
    """A mixture of Gaussians over the positions and von Mises distributions over the rotation.

    The action is the mode of the most probable component: where two actions are right, their mean is not.

    Source: mixture density networks, Bishop 1994. The von Mises distribution is the Gaussian of a circle.
    """

    def __init__(self, config: MixtureConfig, width: int, actions: nn.Module) -> None:
        super().__init__(actions)
        self.num_components, self.min_std = config.num_components, config.min_std
        hidden = (width, config.hidden_width, config.hidden_width)
        # Weights have layers of their own: gradients of narrow components would drown theirs.
        self.gate = mlp((*hidden, config.num_components), last_gain=0.01)
        # Of each component: means, cosine and sine, logarithms of the five standard deviations.
        count = config.num_components * (_POSITIONS + 2 + _POSITIONS + 1)
        self.out = mlp((*hidden, count), last_gain=0.01)
        bias = layer_of(self.out, -1).bias.view(config.num_components, -1)
        with torch.no_grad():
            nn.init.uniform_(bias[:, :_POSITIONS])  # equal components would stay equal
            bias[:, _POSITIONS] = 1.0
            bias[:, _POSITIONS + 2 :] = math.log(0.25)

    def action_loss(self, query_BTD: torch.Tensor, targets: ActionTargets) -> ActionLoss:
        """Return the negative log-likelihood of the demonstrated actions, and the decoded actions."""
        loss = masked_mean(-self.log_density(query_BTD, targets.actions_BTC), targets.steps_BT)
        with torch.no_grad():
            actions_BTC = self.action(query_BTD, greedy)
        return loss, {"loss/action": loss.detach()}, actions_BTC

    @torch.no_grad()
    def fit_prior(self, actions_NC: torch.Tensor) -> None:
        """Start with components at evenly spaced actions of these, as wide as all of them together."""
        positions_NP, yaws_N2 = _planar(actions_NC, torch.float32)
        places = torch.linspace(0, len(actions_NC) - 1, self.num_components).long()
        spread_P = positions_NP.std(dim=0, correction=0).clamp(min=self.min_std)
        mean_2 = yaws_N2.mean(dim=0)
        # Standard deviation of the wrapped normal distribution with this mean vector.
        yaw_std = (-2 * mean_2.norm().clamp(1e-3, 1 - 1e-3).log()).sqrt().clamp(self.min_std, 1.0)
        bias = layer_of(self.out, -1).bias.view(self.num_components, -1)
        bias[:, :_POSITIONS] = positions_NP[places]
        bias[:, _POSITIONS : _POSITIONS + 2] = F.normalize(mean_2, dim=-1)
        bias[:, _POSITIONS + 2 :] = torch.cat([spread_P, yaw_std[None]]).log()

    def log_density(self, query_BTD: torch.Tensor, actions_BTC: torch.Tensor) -> torch.Tensor:
        """Return the logarithm of the density, (B, T), per unit range of each position and radian."""
        logits_BTK, means_BTKP, yaws_BTK2, log_stds_BTKS = self._components(query_BTD)
        positions_BTP, yaw_BT2 = _planar(actions_BTC, query_BTD.dtype)
        stds_BTKS = log_stds_BTKS.exp()
        errors_BTKP = (positions_BTP[:, :, None] - means_BTKP) / stds_BTKS[..., :_POSITIONS]
        normal_BTK = -(0.5 * errors_BTKP.square() + log_stds_BTKS[..., :_POSITIONS]).sum(-1)
        kappa_BTK = stds_BTKS[..., _POSITIONS] ** -2
        cosine_BTK = (yaw_BT2[:, :, None] * yaws_BTK2).sum(-1)
        # I0(κ) e^-κ does not overflow.
        von_mises_BTK = kappa_BTK * (cosine_BTK - 1) - torch.special.i0e(kappa_BTK).log()
        weights_BTK = torch.log_softmax(logits_BTK, dim=-1)
        scale = (0.5 * _POSITIONS + 1) * math.log(2 * math.pi)
        return torch.logsumexp(weights_BTK + normal_BTK + von_mises_BTK, dim=-1) - scale

    def action(self, query_BTD: torch.Tensor, strategy: DecodingStrategy) -> torch.Tensor:
        """Return the mode of the component that the strategy chooses."""
        logits_BTK, means_BTKP, yaws_BTK2, _ = self._components(query_BTD)
        chosen_BT = strategy(logits_BTK)
        return _actions(at(means_BTKP, chosen_BT), at(yaws_BTK2, chosen_BT))

    def _components(self, query_BTD: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Logits, means, unit vectors of the rotation, and logarithms of standard deviations."""
        values = self.out(query_BTD).unflatten(-1, (self.num_components, -1))
        means, yaws, log_stds = values.split((_POSITIONS, 2, _POSITIONS + 1), dim=-1)
        log_stds = log_stds.clamp(math.log(self.min_std), 0.0)
        return self.gate(query_BTD), means, F.normalize(yaws, dim=-1), log_stds


class RegressionHead(ActionHead):
    """Regresses positions, cosine and sine with the Huber loss."""

    def __init__(self, config: RegressionConfig, width: int, actions: nn.Module) -> None:
        super().__init__(actions)
        self.huber_delta = config.huber_delta
        hidden = config.hidden_width
        self.out = mlp((width, hidden, hidden, _POSITIONS + 2), last_gain=0.01)
        bias = layer_of(self.out, -1).bias
        with torch.no_grad():
            bias[:_POSITIONS] = 0.5
            bias[_POSITIONS] = 1.0

    @torch.no_grad()
    def fit_prior(self, actions_NC: torch.Tensor) -> None:
        """Start from the mean of these actions."""
        layer_of(self.out, -1).bias.copy_(torch.cat(_planar(actions_NC, torch.float32), dim=-1).mean(dim=0))

    def action_loss(self, query_BTD: torch.Tensor, targets: ActionTargets) -> ActionLoss:
        """Return the Huber loss of positions and rotation, in units of its delta, and the actions."""
        positions_BTP, yaw_BT2 = self.out(query_BTD).split((_POSITIONS, 2), dim=-1)
        target_BTP, target_BT2 = _planar(targets.actions_BTC, query_BTD.dtype)
        losses = {
            "position": self._huber(positions_BTP, target_BTP),
            "rotation": self._huber(yaw_BT2, target_BT2),
        }
        parts = {f"loss/{name}": masked_mean(loss_BT, targets.steps_BT) for name, loss_BT in losses.items()}
        actions_BTC = _actions(positions_BTP.detach(), yaw_BT2.detach())
        detached = {name: value.detach() for name, value in parts.items()}
        return torch.stack(list(parts.values())).sum(), detached, actions_BTC

    def action(self, query_BTD: torch.Tensor, strategy: DecodingStrategy) -> torch.Tensor:
        """Return the regressed actions; there is nothing to choose from."""
        positions_BTP, yaw_BT2 = self.out(query_BTD).split((_POSITIONS, 2), dim=-1)
        return _actions(positions_BTP, yaw_BT2)

    def _huber(self, values: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        loss = F.huber_loss(values, targets, reduction="none", delta=self.huber_delta)
        return loss.sum(-1) / self.huber_delta


def _planar(actions_BTC: torch.Tensor, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions in unit range, (B, T, 4), and cosine and sine of the rotation, (B, T, 2)."""
    unit_BTC, poses = to_unit_range(actions_BTC), ("pose0", "pose1")
    positions = torch.cat([unit_BTC[..., ACTION_PARTS[f"{pose}_position"]] for pose in poses], dim=-1)
    rotation = yaw_between(actions_BTC)
    return positions.to(dtype), torch.stack([rotation.cos(), rotation.sin()], dim=-1).to(dtype)


def _actions(positions_BTP: torch.Tensor, yaw_BT2: torch.Tensor) -> torch.Tensor:
    """Actions in metres and quaternions, in float32 at least; the rotation need not have unit length."""
    dtype = torch.promote_types(positions_BTP.dtype, torch.float32)
    cosine, sine = yaw_BT2.to(dtype).unbind(-1)
    half = torch.atan2(sine, cosine) / 2
    zero, one = torch.zeros_like(half), torch.ones_like(half)
    quaternions = torch.stack([zero, zero, zero, one, zero, zero, half.sin(), half.cos()], dim=-1)
    pick, place = positions_BTP.to(dtype).split(2, dim=-1)
    rotation0, rotation1 = ((quaternions + 1) / 2).split(4, dim=-1)  # to unit range
    return from_unit_range(torch.cat([pick, rotation0, place, rotation1], dim=-1))


HeadConfig = BinsConfig | AutoregressiveConfig | MixtureConfig | RegressionConfig
HEADS: dict[str, type[HeadConfig]] = {
    "bins": BinsConfig,
    "autoregressive": AutoregressiveConfig,
    "mixture": MixtureConfig,
    "regression": RegressionConfig,
}


def build_action_tokens(config: HeadConfig, width: int) -> ActionEncoder | ComponentTokens:
    """Build the tokens of past actions; before the decoder, so that a seed gives the same weights."""
    if isinstance(config, AutoregressiveConfig):
        return ComponentTokens(width, config.token_std)
    return ActionEncoder(config.action_width, width)


def build_head(config: HeadConfig, width: int, actions: nn.Module) -> ActionHead:
    """Build the head that goes with the tokens of past actions."""
    if isinstance(config, MixtureConfig):
        return MixtureHead(config, width, actions)
    if isinstance(config, RegressionConfig):
        return RegressionHead(config, width, actions)
    kind = AutoregressiveHead if isinstance(config, AutoregressiveConfig) else BinsHead
    return kind(config.hidden_width, width, actions)
