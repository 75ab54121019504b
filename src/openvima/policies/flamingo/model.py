"""VIMA-Flamingo: four latents summarise a pair of frames, and cross-attention reads the prompt.

Shape suffixes as in `nn/policy_network.py`; V views, P patches of a frame, N frame pairs.
"""

import torch
from torch import nn

from openvima.policies.batch import HistoryBatch, PromptBatch
from openvima.policies.flamingo.config import FlamingoConfig
from openvima.policies.nn.decoder import build_decoder
from openvima.policies.nn.heads import build_action_tokens, build_head
from openvima.policies.nn.history import ObservationTokens
from openvima.policies.nn.policy_network import (
    NUM_END_EFFECTORS,
    EncodedPrompt,
    PolicyNetwork,
)
from openvima.policies.nn.prompt_encoder import PromptEncoder
from openvima.policies.nn.resampler import Resampler
from openvima.policies.nn.vit import VisionTransformer, encode_frames


class Flamingo(PolicyNetwork):
    """A Perceiver resampler over the patches of both views.

        prompt   [put, the, 4 latents, into, the, 4 latents, ., end]
        history  [4 latents, action, 4 latents, action, …]
                          |
                     1st action

    Source: VIMA (Jiang et al. 2023), baselines; after Flamingo (Alayrac et al. 2022).
    """

    def __init__(self, config: FlamingoConfig) -> None:
        super().__init__()
        width = config.decoder.width
        self.config = config
        self.frame_encoder = VisionTransformer(config.frame)
        self.resampler = Resampler(config.resampler, width)
        self.prompt = PromptEncoder(config.prompt, image_token_width=width, width=width)
        self.end_effectors = nn.Embedding(NUM_END_EFFECTORS, NUM_END_EFFECTORS)
        self.observation_out = nn.Linear(width + NUM_END_EFFECTORS, width)
        actions = build_action_tokens(config.head, width)
        self.decoder = build_decoder(config.decoder)
        self.head = build_head(config.head, width, actions)

    def encode_images(self, images: torch.Tensor) -> torch.Tensor:
        """Encode frames (..., 3, 64, 128), uint8, to features of patches (..., P, F)."""
        return encode_frames(self.frame_encoder, images)

    def encode_prompt(self, prompts: PromptBatch, features_KF: torch.Tensor) -> EncodedPrompt:
        """Encode words and latents through the text encoder."""
        tokens_IE = self._latents(features_KF[prompts.crop_index_VS])
        return EncodedPrompt(self.prompt(prompts, tokens_IE), prompts.mask_BL)

    def observe(self, history: HistoryBatch, features_KF: torch.Tensor) -> ObservationTokens:
        """Make the latents of each pair of frames."""
        return self.all_frames(self._latents(features_KF[history.crop_index_BTVN]), history)

    def _latents(self, features_VNPF: torch.Tensor) -> torch.Tensor:
        """Resample (..., V, N, P, F) to (..., latents · N, F): the first latent of all pairs first."""
        patches = features_VNPF.movedim(-4, -3).flatten(-3, -2)  # (..., N, V · P, F)
        return self.resampler(patches).transpose(-3, -2).flatten(-3, -2)
