"""VIMA: object tokens, and cross-attention to the prompt.

Shape suffixes as in `nn/policy_network.py`; I image tokens of all prompts.
"""

import torch
from torch import nn

from openvima.policies.batch import HistoryBatch, PromptBatch
from openvima.policies.nn.autoregressive import AutoregressiveHead
from openvima.policies.nn.bins import BinsHead
from openvima.policies.nn.decoder import Decoder, build_decoder
from openvima.policies.nn.heads import build_action_tokens, build_head
from openvima.policies.nn.history import ObservationTokens
from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.policies.nn.policy_network import (
    NUM_END_EFFECTORS,
    EncodedPrompt,
    PolicyNetwork,
)
from openvima.policies.nn.prompt_encoder import PromptEncoder
from openvima.policies.vima.config import VimaConfig


class Vima(PolicyNetwork):
    """One token for each object in each view.

    "Put the {a} into the {b}." with one object in each image, two objects on the table:

        prompt   [put, the, A front, A top, into, the, B front, B top, ., end]
        history  [front 1, front 2, top 1, top 2, action, front 1, front 2, top 1, top 2, …]
                                             |                                       |
                                        1st action                              2nd action

    With `images.fuse_views` both views of an object are one token; with `query_token` the action is decoded
    from a learned token behind the objects instead of the last object token.

    Source: VIMA (Jiang et al. 2023), section 4.
    """

    def __init__(self, config: VimaConfig) -> None:
        super().__init__()
        width = config.decoder.width
        self.config = config
        self.images = ObjectEncoder(config.images)
        self.prompt = PromptEncoder(config.prompt, image_token_width=config.images.width, width=width)
        self.end_effectors = nn.Embedding(NUM_END_EFFECTORS, NUM_END_EFFECTORS)
        self.observation_out = nn.Linear(config.images.width + NUM_END_EFFECTORS, width)
        actions = build_action_tokens(config.head, width)
        self.decoder = build_decoder(config.decoder)
        self.query = nn.Parameter(torch.randn(width) * 0.02) if config.query_token else None
        self.head = build_head(config.head, width, actions)
        # Other heads have no bins, and other decoders no attention to the prompt alone.
        self.explains = isinstance(self.head, BinsHead | AutoregressiveHead) and isinstance(
            self.decoder, Decoder
        )

    def encode_images(self, images: torch.Tensor) -> torch.Tensor:
        """Encode crops (..., 3, 32, 32), uint8, to features (..., F)."""
        return self.images.encode_images(images)

    def encode_prompt(self, prompts: PromptBatch, features_KF: torch.Tensor) -> EncodedPrompt:
        """Encode words and object tokens through the text encoder."""
        tokens_IE = self.images(features_KF[prompts.crop_index_VS], prompts.boxes_VS4, prompts.masks_VS)
        return EncodedPrompt(self.prompt(prompts, tokens_IE), prompts.mask_BL)

    def observe(self, history: HistoryBatch, features_KF: torch.Tensor) -> ObservationTokens:
        """Make object tokens, and the query behind them if there is one."""
        features_BTVNF = features_KF[history.crop_index_BTVN]
        tokens_BTQE = self.images(features_BTVNF, history.boxes_BTVN4, history.masks_BTVN)
        tokens_BTQD = self.add_end_effector(tokens_BTQE, history.end_effector_BT)
        fused = self.config.images.fuse_views
        mask_BTQ = history.masks_BTVN.any(dim=2) if fused else history.masks_BTVN.flatten(2)
        if self.query is not None:
            query_BT1D = self.query.expand(*tokens_BTQD.shape[:2], 1, -1)
            tokens_BTQD = torch.cat([tokens_BTQD, query_BT1D], dim=2)
            mask_BTQ = torch.cat([mask_BTQ, history.steps_BT[..., None]], dim=2)
        query_BT = torch.full_like(history.num_slots_BT, tokens_BTQD.shape[2] - 1)
        if self.query is None:
            # The last slot of the episode itself, be it padding or not; beyond it lies padding of the batch.
            query_BT = query_BT - history.masks_BTVN.shape[-1] + history.num_slots_BT.clamp(min=1)
        return ObservationTokens(tokens_BTQD, mask_BTQ, query_BT, history.steps_BT)
