"""What VIMA, its baselines and MIDAS share: image tokens, a prompt encoder, a decoder, an action head.

They differ in their configs alone, so that ablations exchange one part at a time.

Shape suffixes as in `nn/policy_network.py`; V views, N objects (1 with frames), P patches of a frame, S
objects and J images in all prompts, I image tokens of all prompts, M latents.
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from openvima.errors import ConfigError
from openvima.perception.objects import TOP
from openvima.policies.batch import HistoryBatch, InputLayout, PromptBatch
from openvima.policies.nn.action_head import BinsConfig, BinsHead, ObservationTokens
from openvima.policies.nn.decoder import (
    OBSERVATION_MARK,
    AnyDecoderConfig,
    DecoderConfig,
    PrefixDecoder,
    build_decoder,
)
from openvima.policies.nn.heads import (
    AutoregressiveConfig,
    HeadConfig,
    build_action_tokens,
    build_head,
)
from openvima.policies.nn.image_encoders import (
    ConvConfig,
    Resampler,
    ResamplerConfig,
    VisionTransformer,
    VitConfig,
)
from openvima.policies.nn.object_encoder import NUM_VIEWS, ObjectEncoder, ObjectEncoderConfig
from openvima.policies.nn.policy_network import NUM_END_EFFECTORS, EncodedPrompt, PolicyNetwork
from openvima.policies.nn.prompt_encoder import PromptEncoder, PromptEncoderConfig
from openvima.policies.sizes import SIZES, Size
from openvima.render.camera import CAMERAS, unproject

_LINEAR_RANGE = 4.0
Architecture = Literal["vima", "gato", "flamingo", "gpt", "midas"]
# Table points of the first pixel of the top view, which looks straight down, and of its neighbours.
_TABLE_POINTS = torch.from_numpy(unproject(np.array([(0, 0), (1, 0), (0, 1)]), CAMERAS["top"]))


@dataclass(frozen=True, slots=True)
class TokenPolicyConfig:
    """Sizes of a policy.

    Args:
        architecture: Name of the architecture.
        images: Image tokens: those of an object encoder; or of a transformer over whole frames, one per
            patch, or with a class token one per pair of frames.
        prompt: The prompt encoder.
        decoder: The decoder, with cross-attention to the prompt or with the prompt as prefix.
        head: The action head.
        resampler: Reduces the objects, or the patches, of both views to a fixed number of tokens; None for
            none.
        query_token: Append a learned token to each observation and decode the action from there, instead of
            from its last image token.
        points: Read positions from the object tokens that the action's output points at, instead of from the
            head alone; places also from those in scenes of the prompt and at the first step. A loss of its
            own trains it; see `point_at_objects`.
    """

    architecture: Architecture
    images: ObjectEncoderConfig | VitConfig
    prompt: PromptEncoderConfig
    decoder: AnyDecoderConfig
    head: HeadConfig
    resampler: ResamplerConfig | None = None
    query_token: bool = False
    points: bool = False

    def __post_init__(self) -> None:
        images, width = self.images, self.decoder.width
        if self.points and not self.has_object_tokens:
            raise ConfigError("policy: points needs a token for each object; set it to False.")
        token_width = images.output_width if isinstance(images, VitConfig) else images.width
        if token_width != width:
            raise ConfigError(f"image tokens are {token_width} wide, the decoder {width}; make them equal.")
        if self.resampler is None:
            return
        if isinstance(images, VitConfig) and images.class_token:
            raise ConfigError("policy: a resampler needs patches; images.class_token must be False.")
        if width % self.resampler.num_heads:
            raise ConfigError(
                f"resampler: width {width} must be a multiple of its {self.resampler.num_heads} heads."
            )

    @property
    def has_object_tokens(self) -> bool:
        """Whether each object has a token of its own."""
        return isinstance(self.images, ObjectEncoderConfig) and self.resampler is None

    @property
    def inputs(self) -> InputLayout:
        """Input format: how images are tokenized."""
        images, tokens = self.images, self.resampler.num_latents if self.resampler else 0
        if isinstance(images, ObjectEncoderConfig):
            return InputLayout("objects" if images.fuse_views else "views", tokens_per_image=tokens)
        tokens = tokens or (1 if images.class_token else NUM_VIEWS * images.num_patches)
        return InputLayout("frames", tokens)


def vima(of: Size) -> TokenPolicyConfig:
    """VIMA: objects, and cross-attention to the prompt.

    One token for each object in each view.

    "Put the {a} into the {b}." with one object in each image, two objects on the table:

        prompt   [put, the, A front, A top, into, the, B front, B top, ., end]
        history  [front 1, front 2, top 1, top 2, action, front 1, front 2, top 1, top 2, …]
                                             |                                       |
                                        1st action                              2nd action

    With `images.fuse_views` both views of an object are one token; with `query_token` the action is decoded
    from a learned token behind the objects instead of the last object token.

    Source: VIMA (Jiang et al. 2023), section 4.
    """
    images = ObjectEncoderConfig(of.crop_encoder(), of.image_width, of.width)
    return TokenPolicyConfig("vima", images, of.prompt, of.decoder(), of.bins())


def nano_bins() -> TokenPolicyConfig:
    """As the pointer model `nano`, with the published head: fused views, convolutions, a query token."""
    crop = ConvConfig(width=32, output_width=128)
    images = ObjectEncoderConfig(
        crop, box_width=64, width=128, fuse_views=True, appearance_width=128, crop_dropout=0.5
    )
    decoder = DecoderConfig(width=128, num_layers=2, num_self_heads=4, num_cross_heads=4)
    head = BinsConfig(256, action_width=64)
    return TokenPolicyConfig("vima", images, SIZES["nano"].prompt, decoder, head, query_token=True)


def gato(of: Size) -> TokenPolicyConfig:
    """VIMA-Gato: the patches of frames, and the prompt as prefix.

    Patches of both views in one causal sequence.

        [put, the, 16 patches, into, the, 16 patches, ., end, separator, 16 patches, action, 16 patches, …]
                                                                                  |
                                                                             1st action

    Source: VIMA (Jiang et al. 2023), baselines; after Gato (Reed et al. 2022).
    """
    return TokenPolicyConfig(
        "gato", of.frame_encoder(class_token=False), of.prompt, of.prefix_decoder(), of.bins()
    )


def flamingo(of: Size) -> TokenPolicyConfig:
    """VIMA-Flamingo: resampled patches of frames, and cross-attention to the prompt.

    A Perceiver resampler over the patches of both views.

        prompt   [put, the, 4 latents, into, the, 4 latents, ., end]
        history  [4 latents, action, 4 latents, action, …]
                          |
                     1st action

    Source: VIMA (Jiang et al. 2023), baselines; after Flamingo (Alayrac et al. 2022).
    """
    images = of.frame_encoder(class_token=False)
    return TokenPolicyConfig("flamingo", images, of.prompt, of.decoder(), of.bins(), of.resampler())


def gpt(of: Size) -> TokenPolicyConfig:
    """VIMA-GPT: one token per pair of frames, and the prompt as prefix.

    The class vectors of both views, side by side, are one token.

        [put, the, A, into, the, B, ., end, separator, frames, action, frames, action, …]
                                                            |
                                                       1st action

    Source: VIMA (Jiang et al. 2023), baselines; after GPT (Radford et al. 2018).
    """
    return TokenPolicyConfig(
        "gpt", of.frame_encoder(class_token=True), of.prompt, of.prefix_decoder(), of.bins()
    )


def midas(of: Size) -> TokenPolicyConfig:
    """MIDAS: objects with a token for each view, and the prompt as prefix.

    Object tokens for each view, the prompt as prefix, and one token per action component.

        [put, the, A front, A top, into, …, end, separator, front 1, front 2, top 1, top 2, x0, y0, …, d1, …]
                                                                                       |    |
                                                                                       x0   y0

    The visual residual adds what enters the text encoder for an object to what it returns.

    Source: MIDAS (Li et al. 2023).
    """
    return TokenPolicyConfig(
        "midas",
        ObjectEncoderConfig(of.crop_encoder(), of.image_width, of.width),
        replace(of.prompt, visual_residual=True),
        of.prefix_decoder(),
        AutoregressiveConfig(of.hidden_width, of.initial_std, of.action_width),
    )


class TokenPolicy(PolicyNetwork):
    """Image tokens in prompt and history, and one of two decoders; the configs draw their sequences."""

    def __init__(self, config: TokenPolicyConfig) -> None:
        super().__init__()
        images, width = config.images, config.decoder.width
        self.config = config
        if isinstance(images, ObjectEncoderConfig):
            self.images, token_width = ObjectEncoder(images), width
            self.images.standardize_boxes()
        else:
            self.images = VisionTransformer(images)
            token_width = NUM_VIEWS * width if images.class_token else width
        self.resampler = Resampler(config.resampler, width) if config.resampler else None
        self.prompt = PromptEncoder(config.prompt, image_token_width=token_width, width=width)
        self.end_effectors = nn.Embedding(NUM_END_EFFECTORS, NUM_END_EFFECTORS)
        self.observation_out = nn.Linear(token_width + NUM_END_EFFECTORS, width)
        actions = build_action_tokens(config.head, width)
        self.decoder = build_decoder(config.decoder)
        self.query = nn.Parameter(torch.randn(width) * 0.02) if config.query_token else None
        self.head = build_head(config.head, width, actions)
        self.head.points = config.points
        if config.points:
            self.place_kinds = nn.Parameter(torch.zeros(2, width))
        if token_width == width:
            self._align_attention()
        self.explains = isinstance(self.head, BinsHead)

    def encode_prompt(self, prompts: PromptBatch, features_KF: torch.Tensor) -> EncodedPrompt:
        """Encode words and image tokens through the text encoder."""
        features_VSF = features_KF[prompts.crop_index_VS]
        if isinstance(self.images, ObjectEncoder):
            tokens_IE = self.images(features_VSF, prompts.boxes_VS4, prompts.masks_VS)
            if self.resampler is not None and len(tokens_IE):
                tokens_IE = self._resample_images(self.resampler, prompts, tokens_IE)
        else:
            tokens_IE = self._frame_tokens(features_VSF)
        points_BL2 = self._points_in_scenes(prompts) if self.config.points else None
        return EncodedPrompt(self.prompt(prompts, tokens_IE), prompts.mask_BL, points_BL2)

    def observe(self, history: HistoryBatch, features_KF: torch.Tensor) -> ObservationTokens:
        """Make the image tokens of each step, and the query behind them if there is one."""
        features_BTVNF = features_KF[history.crop_index_BTVN]
        steps_BT, mask_BTQ, points = history.steps_BT, None, ()
        if isinstance(self.images, ObjectEncoder):
            tokens_BTQE = self.images(features_BTVNF, history.boxes_BTVN4, history.masks_BTVN)
            fused = self.images.config.fuse_views
            mask_BTQ = history.masks_BTVN.any(dim=2) if fused else history.masks_BTVN.flatten(2)
            if self.resampler is not None:
                tokens_BTQE, mask_BTQ = self.resampler(tokens_BTQE, mask_BTQ), None
            elif self.config.points:
                points = _points_from_above(history, tokens_BTQE.shape[2])
        else:
            tokens_BTQE = self._frame_tokens(features_BTVNF)
        tokens_BTQD = self.add_end_effector(tokens_BTQE, history.end_effector_BT)
        query_BT = torch.full_like(history.num_slots_BT, tokens_BTQD.shape[2] - 1)
        # Where an episode is asked for its action may not depend on what pads the batch.
        if mask_BTQ is not None:
            # The last slot of the episode itself, be it padding or not; beyond it lies padding of the batch.
            query_BT = query_BT - history.masks_BTVN.shape[-1] + history.num_slots_BT.clamp(min=1)
        else:
            mask_BTQ = steps_BT[..., None].expand(tokens_BTQD.shape[:3])
        if self.query is not None:
            query_BT = torch.full_like(query_BT, tokens_BTQD.shape[2])
            query_BT1D = self.query.expand(*tokens_BTQD.shape[:2], 1, -1)
            tokens_BTQD = torch.cat([tokens_BTQD, query_BT1D], dim=2)
            mask_BTQ = torch.cat([mask_BTQ, steps_BT[..., None]], dim=2)
            points = [F.pad(points_BTQ2, (0, 0, 0, 1), value=math.inf) for points_BTQ2 in points]
        return ObservationTokens(tokens_BTQD, mask_BTQ, query_BT, steps_BT, *points)

    def _points_in_scenes(self, prompts: PromptBatch) -> torch.Tensor:
        """Return the table points of the objects in scenes that tokens stand for, (B, L, 2), from above."""
        points_S2 = prompts.positions_S2.masked_fill(~prompts.in_scene_S[:, None], math.inf)
        from_above = 0 if self.config.images.fuse_views else len(points_S2)  # front views come first
        stands_BL = (prompts.object_index_BL >= from_above) & prompts.mask_BL
        points_BL2 = points_S2.new_full((*stands_BL.shape, 2), math.inf)
        points_BL2[stands_BL] = points_S2[prompts.object_index_BL[stands_BL] - from_above]
        return points_BL2

    @torch.no_grad()
    def _align_attention(self) -> None:
        """Let fresh attention begin where the images of scene and prompt look alike.

        Layers that carry image tokens into the text encoder and into the history start as the identity, and
        the first half of attention to the prompt compares its two sides by one matrix. Random layers would
        have to find this agreement before any texture can be told from another; see docs/train_vima.md.
        """
        layers = [layer for layer in self.prompt.images if isinstance(layer, nn.Linear)]
        if layers[0].weight.is_meta:  # weights are loaded later
            return
        carriers = [*layers, self.observation_out]
        if isinstance(self.prompt.out, nn.Linear):
            carriers.append(self.prompt.out)
        for layer in carriers:
            nn.init.eye_(layer.weight)
            if layer.bias is not None:
                layer.bias.zero_()
        # Image tokens are of the order of 1: so far above zero, the ReLUs between the layers are linear.
        layers[0].bias.fill_(_LINEAR_RANGE)
        layers[-1].bias.fill_(-_LINEAR_RANGE)
        self.prompt.text.align()
        self.decoder.align()
        self.head.actions.align()
        if isinstance(self.decoder, PrefixDecoder):  # it tells images of the prompt from observations
            for layer, mark in ((layers[-1], 0.0), (self.observation_out, OBSERVATION_MARK)):
                layer.weight[0], layer.bias[0] = 0, mark

    def _frame_tokens(self, features: torch.Tensor) -> torch.Tensor:
        """Make tokens of pairs of frames, (..., tokens · N, E): the first token of all pairs first.

        Args:
            features: Of class tokens, (..., V, N, F), or of patches, (..., V, N, P, F).
        """
        if self.config.images.class_token:
            return features.transpose(-3, -2).flatten(-2)
        patches = features.movedim(-4, -3).flatten(-3, -2)  # (..., N, V · P, F)
        tokens = patches if self.resampler is None else self.resampler(patches)
        return tokens.transpose(-3, -2).flatten(-3, -2)

    def _resample_images(
        self, resampler: Resampler, prompts: PromptBatch, tokens_IE: torch.Tensor
    ) -> torch.Tensor:
        """Resample the objects of each image in the prompts, (latents · S, E): the first latent of all first.

        The resampler wants one padded row of objects per image, (J, N), but objects come in one row of all
        prompts, (S), without a mark where an image begins. The prompts tell: an image has its tokens at the
        number of its first object, plus a multiple of S for each further latent. So the numbers that occur,
        modulo S, are the first objects. The result is numbered like that again; rows of the other objects
        are copies that no token refers to.
        """
        # Objects (S) lie image after image, and images (J) begin where a prompt names them first: J and the
        # place within (N) are read from that. Latents go back to the rows of their image's objects, as tokens
        # do.
        count = prompts.masks_VS.shape[1]
        index_BL = prompts.object_index_BL
        is_first_S = torch.zeros(count, dtype=torch.bool, device=tokens_IE.device)
        is_first_S[index_BL[index_BL >= 0] % count] = True
        image_S, first_J = is_first_S.cumsum(dim=0) - 1, is_first_S.nonzero().squeeze(1)
        slot_S = torch.arange(count, device=tokens_IE.device) - first_J[image_S]  # N: its place in its image
        mask_QS = prompts.masks_VS
        if len(tokens_IE) == count:  # fused views
            mask_QS = mask_QS.any(dim=0, keepdim=True)
        tokens_QSE = tokens_IE.unflatten(0, mask_QS.shape)
        shape = (len(first_J), int(slot_S.max()) + 1, len(mask_QS))
        tokens_JNQE = tokens_IE.new_zeros(*shape, tokens_IE.shape[-1])
        tokens_JNQE = tokens_JNQE.index_put((image_S, slot_S), tokens_QSE.transpose(0, 1))
        mask_JNQ = mask_QS.new_zeros(shape).index_put((image_S, slot_S), mask_QS.T)
        latents_JME = resampler(tokens_JNQE.flatten(1, 2), mask_JNQ.flatten(1))
        return latents_JME[image_S].transpose(0, 1).flatten(0, 1)


def _points_from_above(history: HistoryBatch, num_tokens: int) -> list[torch.Tensor]:
    """Return the table points under the boxes, and under the most interior pixels, of the top view.

    Both are (B, T, Q, 2), of the last N of Q tokens.
    """
    boxes_BTN4, mask_BTN = history.boxes_BTVN4[:, :, TOP], history.masks_BTVN[:, :, TOP]
    origin, right, down = _TABLE_POINTS.to(boxes_BTN4.device)
    axes = torch.stack([right - origin, down - origin])
    points_BTN2 = origin + boxes_BTN4[..., :2].to(axes) @ axes
    pad = (0, 0, num_tokens - mask_BTN.shape[-1], 0)
    return [
        F.pad(each_BTN2.masked_fill(~mask_BTN[..., None], math.inf), pad, value=math.inf)
        for each_BTN2 in (points_BTN2, history.grasps_BTN2.to(axes))
    ]
