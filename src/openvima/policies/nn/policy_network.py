"""What every policy network of the package can do, for training and for acting, and what it explains.

Shape suffixes: B batch, T steps, L prompt positions, Q tokens of a step, K images, F width of image
features, D width of the decoder, E width of an image token, C components of an action, or place candidates.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.batch import HistoryBatch, PromptBatch
from openvima.policies.nn.action_head import ObservationTokens, actions_from_bins
from openvima.policies.nn.actions import (
    ACTION_PARTS,
    ActionTargets,
    DecodingStrategy,
    action_metrics,
    greedy,
)
from openvima.policies.nn.decoder import Decoder, KVCache, PrefixDecoder, last_attention
from openvima.policies.nn.layers import TensorRecord
from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.policies.nn.prompt_encoder import PromptEncoder
from openvima.scene import END_EFFECTORS
from openvima.scene.explanation import PLACE_KINDS


@dataclass(frozen=True, slots=True, eq=False)
class StepTrace:
    """Logits and attention of one step.

    Args:
        logits: Of the object in view, the place candidate and the rotation, (B, classes) each; without the
            rotation where bins give it, and none where they give the whole action.
        attention: Kind of attention to weights of the prompt's positions, (B, L), which sum to 1.
        places: The place candidates: positions in metres, (B, C, 2), which exist, (B, C), and the kind of
            each, an index of `PLACE_KINDS`, (C,). None without any.
        bins: Logits of each component of the action, of policies over bins.
    """

    logits: Sequence[torch.Tensor]
    attention: Mapping[str, torch.Tensor]
    places: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None
    bins: Sequence[torch.Tensor] = ()


# Logits of each class that was decoded in a step, (B, 1, classes), and its index, (B, 1); in order.
Decoded = Sequence[tuple[torch.Tensor, torch.Tensor]]


def normalize_weights(weights: Mapping[str, torch.Tensor], mask_BL: torch.Tensor) -> dict[str, torch.Tensor]:
    """Scale weights (B, L) of each kind to a sum of 1; equal ones where nothing has any."""
    equal_BL, result = mask_BL / mask_BL.sum(dim=-1, keepdim=True), {}
    for kind, weights_BL in weights.items():
        weights_BL = weights_BL * mask_BL
        total_B1 = weights_BL.sum(dim=-1, keepdim=True)
        scaled_BL = weights_BL / total_B1.clamp(min=torch.finfo(total_B1.dtype).tiny)
        result[kind] = torch.where(total_B1 > 0, scaled_BL, equal_BL)
    return result


NUM_END_EFFECTORS = len(END_EFFECTORS)


@dataclass(frozen=True, slots=True, eq=False)
class EncodedPrompt(TensorRecord):
    """Encoded prompts; constant within an episode.

    Args:
        tokens_BLD: Encoded words and images.
        mask_BL: Which positions exist.
        points_BL2: Table points of the objects in scenes that tokens stand for, infinite for others; None
            where positions are not read from objects.
    """

    tokens_BLD: torch.Tensor
    mask_BL: torch.Tensor
    points_BL2: torch.Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class StepInputs:
    """What the actions of the next steps are decoded from.

    Args:
        prompt: Encoded prompts.
        state: What `init_cache` or the last `decode_step` returned.
        history: Observations of these steps; one when acting.
        features_KF: Encoded images, by image index.
        previous_BTC: The action taken before each observation, metres and quaternions.
        has_previous_BT: Whether there was one.
    """

    prompt: Any  # the network's own record
    state: Any  # likewise
    history: HistoryBatch
    features_KF: torch.Tensor
    previous_BTC: torch.Tensor
    has_previous_BT: torch.Tensor


class PolicyNetwork(nn.Module):
    """Multimodal prompt and history to actions.

    A model defines its parts, `encode_prompt` and `observe`. Decoding, the loss and acting are those of its
    action head; the pointer models replace them.

    Attributes:
        config: All sizes.
    """

    config: Any  # the config of the model
    images: Any  # `ObjectEncoder`, or `VisionTransformer` for whole frames
    prompt: PromptEncoder
    decoder: Decoder | PrefixDecoder
    head: Any  # one of `nn/heads.py`; the pointer models have their own
    end_effectors: nn.Embedding
    observation_out: nn.Linear
    place_kinds: nn.Parameter  # added to tokens in scenes of the prompt and at the first step, (2, D)
    score = "accuracy"  # the metric that selects the best checkpoint, a fraction of 1
    explains: bool = False  # whether `explain_step` is of use

    @property
    def object_encoder(self) -> ObjectEncoder | None:
        """The encoder of object crops; None for models of whole frames."""
        return self.images if isinstance(self.images, ObjectEncoder) else None

    def encode_images(self, images: torch.Tensor) -> torch.Tensor:
        """Encode crops or frames (..., 3, height, width), uint8, to features (..., F), or (..., P, F)."""
        return self.images.encode_images(images)

    def encode_prompt(self, prompts: PromptBatch, features_KF: torch.Tensor) -> Any:
        """Encode prompts; once per episode.

        Args:
            prompts: The prompts.
            features_KF: Encoded images, by image index.
        """
        raise NotImplementedError

    def observe(self, history: HistoryBatch, features_KF: torch.Tensor) -> ObservationTokens:
        """Make the tokens of each observation.

        Args:
            history: Observations.
            features_KF: Encoded images, by image index.
        """
        raise NotImplementedError

    def fit_prior(self, actions_NC: torch.Tensor) -> None:
        """Let a fresh action head start from the distribution of demonstrated actions, (N, 12)."""
        self.head.fit_prior(actions_NC)

    def init_cache(self, prompt: Any) -> Any:
        """Return the state of decoding after the prompt and before the first step."""
        return self.decoder.init_cache(prompt.tokens_BLD, prompt.mask_BL)

    def loss(
        self, prompt: Any, history: HistoryBatch, features_KF: torch.Tensor, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Decode whole histories and compare with what was demonstrated.

        Args:
            prompt: Encoded prompts.
            history: Observations.
            features_KF: Encoded images, by image index.
            targets: Demonstrated actions. The prediction of one depends on earlier ones alone; with an
                autoregressive head also on its own components before.

        Returns:
            The loss, a mean over all steps, and metrics: every named part of the loss as `loss/<name>`, and
            accuracies; see `action_metrics`.
        """
        observations, cache = self._observe(prompt, self.init_cache(prompt), history, features_KF)
        loss, metrics, actions_BTC = self.head.loss(self.decoder, cache, observations, targets)
        in_view_BTN = history.masks_BTVN.any(dim=2) & (self.object_encoder is not None)
        return loss, {**metrics, **action_metrics(actions_BTC, targets, history.grasps_BTN2, in_view_BTN)}

    def decode_step(self, step: StepInputs, strategy: DecodingStrategy = greedy) -> tuple[torch.Tensor, Any]:
        """Decode the actions of the next steps, of which the earlier ones are in the state.

        Args:
            step: The inputs.
            strategy: How a class is decoded from logits.

        Returns:
            Actions, shape (B, T, 12), metres and quaternions, within bounds; and the next state.

        Raises:
            PolicyError: Prompt or history is longer than the decoder takes.
        """
        observations, state = self._observe(step.prompt, step.state, step.history, step.features_KF)
        dtype = observations.tokens_BTQD.dtype
        previous = self.head.segment(step.previous_BTC, step.has_previous_BT, dtype)
        (_, outputs_BTQD), state = self.decoder.decode_segments(state, [previous, observations.segment()])
        query_BTD = observations.query(outputs_BTQD)
        return self.head.decode(self.decoder, state, query_BTD, observations, strategy), state

    def _observe(
        self, prompt: Any, cache: KVCache, history: HistoryBatch, features_KF: torch.Tensor
    ) -> tuple[ObservationTokens, KVCache]:
        """Make the tokens of each observation, with those of other scenes if places may be there."""
        observations = self.observe(history, features_KF)
        if observations.points_BTQ2 is None:
            return observations, cache
        if not cache.first:
            cache = replace(cache, first=(observations.tokens_BTQD[:, 0], observations.points_BTQ2[:, 0]))
        first_BQD, points_BQ2 = cache.first
        in_prompt_D, at_first_D = self.place_kinds
        tokens_BLD = torch.cat([prompt.tokens_BLD + in_prompt_D, first_BQD + at_first_D], dim=1)
        points_BL2 = torch.cat([prompt.points_BL2.to(points_BQ2), points_BQ2], dim=1)
        return replace(observations, scene_tokens_BLD=tokens_BLD, scene_points_BL2=points_BL2), cache

    def explain_step(self, step: StepInputs, decoded: Decoded) -> StepTrace:
        """Explain one step: what `decode_step` has decoded, and attention, for which it decodes once more.

        Here for heads over bins. Attention is that of the last layer; with a prefix that of the first one,
        as tokens of the prompt later hold what came before them as well.
        """
        mask_BL, weights, decoder = step.prompt.mask_BL, [], self.decoder
        block = decoder.cross_blocks[-1] if isinstance(decoder, Decoder) else decoder.self_blocks[0]
        hook = block.register_forward_pre_hook(
            lambda _, inputs: weights.append(last_attention(block, *inputs))
        )
        try:
            self.decode_step(step)
        finally:
            hook.remove()
        # An autoregressive head goes on with the components of the action; a prefix goes on with the history.
        weights_BL = weights[0].mean(dim=1)[:, : mask_BL.shape[1]]
        attention = normalize_weights({"decoder": weights_BL}, mask_BL)
        pointing = self.head.pointing_indices if self.head.points else ()
        bins = [logits[:, 0] for number, (logits, _) in enumerate(decoded) if number not in pointing]
        if not pointing:
            return StepTrace((), attention, bins=bins)
        observations, _ = self._observe(step.prompt, step.state, step.history, step.features_KF)
        points_BC2, num_own = observations.candidates(1)[1][:, 0], observations.tokens_BTQD.shape[2]
        picks_BQ, places_BC = (decoded[number][0][:, 0] for number in pointing)
        end = num_own - self.config.query_token  # before it are the tokens of the top view
        classes_BK = torch.stack([each.argmax(-1) for each in bins], dim=-1)
        at_no_object_B2 = actions_from_bins(classes_BK, points_BC2.dtype)[:, ACTION_PARTS["pose1_position"]]
        num_kept = mask_BL.shape[1], points_BC2.shape[1] - num_own - mask_BL.shape[1], 1
        kinds = [PLACE_KINDS.index(kind) for kind in ("in view", "prompt", "first step", "grid")]
        return StepTrace(
            (picks_BQ[:, end - step.history.masks_BTVN.shape[-1] : end], places_BC),
            attention,
            (
                torch.cat([points_BC2, at_no_object_B2[:, None]], dim=1),
                F.pad(points_BC2[..., 0].isfinite(), (0, 1), value=True),
                torch.tensor(kinds).repeat_interleave(torch.tensor([num_own, *num_kept])),
            ),
            bins,
        )

    def add_end_effector(self, tokens_BTQE: torch.Tensor, end_effector_BT: torch.Tensor) -> torch.Tensor:
        """Fuse image tokens with the end effector, and map them to the decoder's width, (B, T, Q, D)."""
        effector_BT1E = self.end_effectors(end_effector_BT)[:, :, None]
        effector_BTQE = effector_BT1E.expand(*tokens_BTQE.shape[:3], NUM_END_EFFECTORS)
        return self.observation_out(torch.cat([tokens_BTQE, effector_BTQE], dim=-1))
