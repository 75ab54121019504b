"""VIMA-GPT: one token summarises a pair of frames, and the prompt is the prefix of the sequence.

Shape suffixes as in `nn/policy_network.py`; V views, N frame pairs.
"""

import torch
from torch import nn

from openvima.policies.batch import HistoryBatch, PromptBatch
from openvima.policies.gpt.config import GptConfig
from openvima.policies.nn.decoder import build_decoder
from openvima.policies.nn.heads import build_action_tokens, build_head
from openvima.policies.nn.history import ObservationTokens
from openvima.policies.nn.object_encoder import NUM_VIEWS
from openvima.policies.nn.policy_network import (
    NUM_END_EFFECTORS,
    EncodedPrompt,
    PolicyNetwork,
)
from openvima.policies.nn.prompt_encoder import PromptEncoder
from openvima.policies.nn.vit import VisionTransformer, encode_frames


class Gpt(PolicyNetwork):
    """The class vectors of both views, side by side, are one token.

        [put, the, A, into, the, B, ., end, separator, frames, action, frames, action, …]
                                                            |
                                                       1st action

    Source: VIMA (Jiang et al. 2023), baselines; after GPT (Radford et al. 2018).
    """

    def __init__(self, config: GptConfig) -> None:
        super().__init__()
        width = config.decoder.width
        self.config = config
        self.frame_encoder = VisionTransformer(config.frame)
        self.prompt = PromptEncoder(config.prompt, image_token_width=NUM_VIEWS * width, width=width)
        self.end_effectors = nn.Embedding(NUM_END_EFFECTORS, NUM_END_EFFECTORS)
        self.observation_out = nn.Linear(NUM_VIEWS * width + NUM_END_EFFECTORS, width)
        actions = build_action_tokens(config.head, width)
        self.decoder = build_decoder(config.decoder)
        self.head = build_head(config.head, width, actions)

    def encode_images(self, images: torch.Tensor) -> torch.Tensor:
        """Encode frames (..., 3, 64, 128), uint8, to class vectors (..., F)."""
        return encode_frames(self.frame_encoder, images)

    def encode_prompt(self, prompts: PromptBatch, features_KF: torch.Tensor) -> EncodedPrompt:
        """Encode words and frames through the text encoder."""
        tokens_IE = _both_views(features_KF[prompts.crop_index_VS])
        return EncodedPrompt(self.prompt(prompts, tokens_IE), prompts.mask_BL)

    def observe(self, history: HistoryBatch, features_KF: torch.Tensor) -> ObservationTokens:
        """Make one token of each pair of frames."""
        return self.all_frames(_both_views(features_KF[history.crop_index_BTVN]), history)


def _both_views(features_VNF: torch.Tensor) -> torch.Tensor:
    """Concatenate the class vectors of both views, (..., N, V · F)."""
    return features_VNF.transpose(-3, -2).flatten(-2)
