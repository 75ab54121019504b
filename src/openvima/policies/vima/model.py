"""The VIMA network: prompt and history of objects and actions in, actions out.

Shape suffixes: B batch, T steps, L prompt places, S objects in all prompts, V views, N objects in view,
Q slots of a step, P places kept, D width of the decoder, F width of crop features, W width of the prompt
encoder, C components of an action.
"""

from dataclasses import dataclass

import torch
from torch import nn

from openvima.policies.layers.decoder import Decoder
from openvima.policies.layers.mlp import mlp
from openvima.policies.layers.object_encoder import ObjectEncoder
from openvima.policies.layers.text_encoder import TextEncoder
from openvima.policies.vima.config import VimaConfig
from openvima.policies.vima.heads.base import (
    ACTION_PARTS,
    ActionHead,
    HeadInputs,
    to_unit_range,
)
from openvima.policies.vima.heads.bins import BinsHead
from openvima.policies.vima.heads.pointing import PointingHead
from openvima.policies.vima.inputs import HistoryBatch, PromptBatch
from openvima.scene import END_EFFECTORS

NUM_END_EFFECTORS = len(END_EFFECTORS)
SUCTION = END_EFFECTORS.index("suction")


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """Encoded prompts: what stays the same through an episode.

    Args:
        tokens_BLD: Encoded words and objects.
        roles_BLD: The same, encoded without knowing what the objects look like.
        mask_BL: Which places exist.
        object_mask_BL: Which of them are objects.
        appearance_BLA: Appearance of these objects; zero elsewhere.
    """

    tokens_BLD: torch.Tensor
    roles_BLD: torch.Tensor
    mask_BL: torch.Tensor
    object_mask_BL: torch.Tensor
    appearance_BLA: torch.Tensor

    def select(self, rows: list[int]) -> "Memory":
        """Return the prompts of some rows of the batch."""
        return Memory(
            self.tokens_BLD[rows],
            self.roles_BLD[rows],
            self.mask_BL[rows],
            self.object_mask_BL[rows],
            self.appearance_BLA[rows],
        )


class Vima(nn.Module):
    """Multimodal prompt -> cross-attention -> causal decoder over the history -> action head.

    "Put the {a} into the {b}." with one object in each image, two objects on the table, second step:

        prompt   [put, the, A, into, the, B, ., end]
        history  [obj, obj, query, action, obj, obj, query]
                             |                        |
                         1st action               2nd action

    The query is a learned token, or, as in the published policies, simply the last object of the step.
    """

    def __init__(self, config: VimaConfig) -> None:
        super().__init__()
        width, words = config.decoder.width, config.text.width
        self.config = config
        self.objects = ObjectEncoder(config.objects)
        self.words = nn.Embedding(config.vocabulary_size, words)
        self.prompt_objects = mlp((width, config.prompt_object_width, config.prompt_object_width, words))
        self.text = TextEncoder(config.text)
        # The published 768-wide policies have no layer here, since both widths are equal.
        self.prompt_out = nn.Identity() if words == width else nn.Linear(words, width, bias=False)
        self.end_effectors = nn.Embedding(NUM_END_EFFECTORS, NUM_END_EFFECTORS)
        self.observation_out = nn.Linear(width + NUM_END_EFFECTORS, width)
        self.actions = ActionEncoder(config.action_width, width)
        self.decoder = Decoder(config.decoder)
        self.query = nn.Parameter(torch.randn(width) * 0.02) if config.query_token else None
        self.head: ActionHead = _head(config)

    def encode_prompt(self, prompts: PromptBatch, features_KF: torch.Tensor) -> Memory:
        """Encode prompts; needed once an episode.

        Args:
            prompts: The prompts.
            features_KF: Encoded crops, by number.
        """
        features_VSF = features_KF[prompts.crops_VS]
        is_object_BL = (prompts.slots_BL >= 0) & prompts.mask_BL
        encoded_BLD = self._read(prompts, features_VSF)
        width = self.config.objects.appearance_width
        appearance_BLA = encoded_BLD.new_zeros(*is_object_BL.shape, width)
        if not width:
            return Memory(encoded_BLD, encoded_BLD, prompts.mask_BL, is_object_BL, appearance_BLA)
        roles_BLD = self._read(prompts, torch.zeros_like(features_VSF))
        if prompts.masks_VS.shape[1]:
            looks_SA = self.objects.embed_appearance(features_VSF, prompts.masks_VS)
            appearance_BLA = looks_SA[prompts.slots_BL.clamp(min=0)] * is_object_BL[..., None]
        return Memory(encoded_BLD, roles_BLD, prompts.mask_BL, is_object_BL, appearance_BLA)

    def _read(self, prompts: PromptBatch, features_VSF: torch.Tensor) -> torch.Tensor:
        """Run the text encoder over words and objects, shape (B, L, D)."""
        tokens_SW = self.prompt_objects(self.objects(features_VSF, prompts.boxes_VS4, prompts.masks_VS))
        tokens_BLW = self.words(prompts.words_BL)
        if len(tokens_SW):
            objects_BLW = tokens_SW[prompts.slots_BL.clamp(min=0)]
            tokens_BLW = torch.where((prompts.slots_BL >= 0)[..., None], objects_BLW, tokens_BLW)
        return self.prompt_out(self.text(tokens_BLW, prompts.mask_BL))

    def forward(
        self, memory: Memory, history: HistoryBatch, features_KF: torch.Tensor, actions_BTC: torch.Tensor
    ) -> HeadInputs:
        """Run the decoder over whole histories.

        Args:
            memory: Encoded prompts.
            history: Observations.
            features_KF: Encoded crops, by number.
            actions_BTC: Actions taken, metres and quaternions; the last step's is never looked at.

        Returns:
            What the action head needs at every step.
        """
        features = features_KF[history.crops_BTVN]
        slots_BTQD, mask_BTQ = self.observe(history, features)
        unit_BTC = self.head.as_history(to_unit_range(actions_BTC.to(slots_BTQD.dtype)))
        outputs_BTQD = self.decode(memory, slots_BTQD, mask_BTQ, self.actions(unit_BTC), history.steps_BT)
        return HeadInputs(
            query_BTD=outputs_BTQD[:, :, -1],
            objects_BTND=outputs_BTQD[:, :, :-1] if self.query is not None else outputs_BTQD,
            masks_BTN=history.masks_BTVN.any(dim=2),
            appearance_BTNA=self._appearance(features, history.masks_BTVN),
            positions_BTN2=history.positions_BTN2.to(slots_BTQD.dtype),
            grasps_BTN2=history.grasps_BTN2.to(slots_BTQD.dtype),
            lifts_BT=history.end_effector_BT == SUCTION,
            prompt_BMD=memory.roles_BLD,
            prompt_masks_BM=memory.object_mask_BL,
            prompt_appearance_BMA=memory.appearance_BLA,
        )

    def observe(
        self, history: HistoryBatch, features_BTVNF: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Make the slots of each step: objects, then the query if there is one; and which of them exist."""
        tokens_BTQD = self.objects(features_BTVNF, history.boxes_BTVN4, history.masks_BTVN)
        effector = self.end_effectors(history.end_effector_BT)[:, :, None]
        effector = effector.expand(*tokens_BTQD.shape[:3], NUM_END_EFFECTORS)
        tokens_BTQD = self.observation_out(torch.cat([tokens_BTQD, effector], dim=-1))
        views_BTVN = history.masks_BTVN
        mask_BTQ = views_BTVN.any(dim=2) if self.config.objects.fuse_views else views_BTVN.flatten(2)
        if self.query is None:
            return tokens_BTQD, mask_BTQ
        query_BT1D = self.query.expand(*tokens_BTQD.shape[:2], 1, -1)
        mask_BTQ = torch.cat([mask_BTQ, history.steps_BT[..., None]], dim=2)
        return torch.cat([tokens_BTQD, query_BT1D], dim=2), mask_BTQ

    def decode(
        self,
        memory: Memory,
        slots_BTQD: torch.Tensor,
        mask_BTQ: torch.Tensor,
        actions_BTD: torch.Tensor,
        steps_BT: torch.Tensor,
    ) -> torch.Tensor:
        """Interleave slots and actions in time, decode, and return the outputs at the slots.

        Masked places are left out, except the last slot of each step: it is read even if it is padding.
        """
        batch, steps, slots = mask_BTQ.shape
        sequence_BLD = torch.cat([slots_BTQD, actions_BTD[:, :, None]], dim=2).flatten(1, 2)
        mask_BL = torch.cat([mask_BTQ, steps_BT[..., None]], dim=2).flatten(1)
        read = torch.zeros(slots + 1, dtype=torch.bool, device=mask_BL.device)
        read[slots - 1] = True
        kept_BL = mask_BL | (read.repeat(steps) & steps_BT.repeat_interleave(slots + 1, dim=1))
        order_BP = kept_BL.to(torch.int8).argsort(dim=1, descending=True, stable=True)
        order_BP = order_BP[:, : int(kept_BL.sum(dim=1).max())]
        places_BPD = order_BP[..., None].expand(-1, -1, sequence_BLD.shape[-1])
        decoded_BPD = self.decoder(
            sequence_BLD.gather(1, places_BPD),
            mask_BL.gather(1, order_BP),
            prompt_BPD=memory.tokens_BLD,
            prompt_mask_BP=memory.mask_BL,
        )
        outputs_BLD = torch.zeros_like(sequence_BLD).scatter(1, places_BPD, decoded_BPD)
        return outputs_BLD.view(batch, steps, slots + 1, -1)[:, :, :-1]

    def _appearance(self, features_BTVNF: torch.Tensor, masks_BTVN: torch.Tensor) -> torch.Tensor:
        if self.config.objects.appearance_width:
            return self.objects.embed_appearance(features_BTVNF, masks_BTVN)
        return features_BTVNF.new_zeros(*masks_BTVN.any(dim=2).shape, 0)


class ActionEncoder(nn.Module):
    """A past action -> one token: a stack for each of its four parts, then one linear layer."""

    def __init__(self, part_width: int, width: int) -> None:
        super().__init__()
        sizes = [part.stop - part.start for part in ACTION_PARTS.values()]
        self.parts = nn.ModuleList(mlp((size, part_width, part_width)) for size in sizes)
        self.out = nn.Linear(len(sizes) * part_width, width)

    def forward(self, unit_BTC: torch.Tensor) -> torch.Tensor:
        """Map actions in unit range, shape (..., 12), to tokens (..., D)."""
        places = ACTION_PARTS.values()
        parts = [stack(unit_BTC[..., place]) for stack, place in zip(self.parts, places, strict=True)]
        return self.out(torch.cat(parts, dim=-1))


def build_model(config: VimaConfig, *, seed: int) -> Vima:
    """Build a network with fresh weights that follow from the seed; global random state stays as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Vima(config)


def _head(config: VimaConfig) -> ActionHead:
    width = config.decoder.width
    if config.pointing is not None:
        return PointingHead(config.pointing, width)
    assert config.bins is not None
    return BinsHead(config.bins, width)
