"""MIDAS: VIMA's object tokens, one decoder over prompt and history, autoregressive actions.

Shape suffixes as in `nn/policy_network.py`; I image tokens of all prompts.
"""

import torch
from torch import nn

from openvima.policies.batch import HistoryBatch, PromptBatch
from openvima.policies.midas.config import MidasConfig
from openvima.policies.nn.decoder import build_decoder
from openvima.policies.nn.heads import build_action_tokens, build_head
from openvima.policies.nn.history import ObservationTokens
from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.policies.nn.policy_network import (
    NUM_END_EFFECTORS,
    EncodedPrompt,
    PolicyNetwork,
)
from openvima.policies.nn.prompt_encoder import PromptEncoder


class Midas(PolicyNetwork):
    """Object tokens for each view, the prompt as prefix, and one token per action component.

        [put, the, A front, A top, into, …, end, separator, front 1, front 2, top 1, top 2, x0, y0, …, d1, …]
                                                                                       |    |
                                                                                       x0   y0

    The visual residual adds what enters the text encoder for an object to what it returns.

    Source: MIDAS (Li et al. 2023).
    """

    def __init__(self, config: MidasConfig) -> None:
        super().__init__()
        width = config.decoder.width
        self.config = config
        self.images = ObjectEncoder(config.images)
        self.prompt = PromptEncoder(config.prompt, image_token_width=config.images.width, width=width)
        self.end_effectors = nn.Embedding(NUM_END_EFFECTORS, NUM_END_EFFECTORS)
        self.observation_out = nn.Linear(config.images.width + NUM_END_EFFECTORS, width)
        actions = build_action_tokens(config.head, width)
        self.decoder = build_decoder(config.decoder)
        self.head = build_head(config.head, width, actions)

    def encode_images(self, images: torch.Tensor) -> torch.Tensor:
        """Encode crops (..., 3, 32, 32), uint8, to features (..., F)."""
        return self.images.encode_images(images)

    def encode_prompt(self, prompts: PromptBatch, features_KF: torch.Tensor) -> EncodedPrompt:
        """Encode words and object tokens through the text encoder."""
        tokens_IE = self.images(features_KF[prompts.crop_index_VS], prompts.boxes_VS4, prompts.masks_VS)
        return EncodedPrompt(self.prompt(prompts, tokens_IE), prompts.mask_BL)

    def observe(self, history: HistoryBatch, features_KF: torch.Tensor) -> ObservationTokens:
        """Make object tokens; the last one of the episode is the query, be it padding or not."""
        features_BTVNF = features_KF[history.crop_index_BTVN]
        tokens_BTQE = self.images(features_BTVNF, history.boxes_BTVN4, history.masks_BTVN)
        tokens_BTQD = self.add_end_effector(tokens_BTQE, history.end_effector_BT)
        last_BT = tokens_BTQD.shape[2] - 1 - history.masks_BTVN.shape[-1]
        query_BT = last_BT + history.num_slots_BT.clamp(min=1)
        return ObservationTokens(tokens_BTQD, history.masks_BTVN.flatten(2), query_BT, history.steps_BT)
