"""The network that all policies of the family are: prompt and history in, what an action head needs out.

Its members differ in how images become tokens and in how the history is read in the light of the prompt; both
are parts that the config names. See `openvima.policies.families`.

Shape suffixes: B batch, T steps, L prompt places, I image tokens of all prompts, S objects in all prompts, V
views, N objects in view, M objects in one prompt, Q slots of a step, P places kept, D width of the trunk, F
width of image features, C components of an action.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.batch import HistoryBatch, PromptBatch
from openvima.policies.config import PolicyConfig
from openvima.policies.heads.autoregressive import (
    AutoregressiveConfig,
    AutoregressiveHead,
    ComponentTokens,
)
from openvima.policies.heads.base import (
    ActionHead,
    Choose,
    HeadInputs,
    Recollection,
    Remembered,
    likeliest,
    to_unit_range,
)
from openvima.policies.heads.bins import BinsConfig, BinsHead
from openvima.policies.heads.copying import CopyingConfig, CopyingHead
from openvima.policies.heads.pointing import PointingHead
from openvima.policies.nn.action_encoder import ActionEncoder
from openvima.policies.nn.comparison import Comparison, Sights, TurnBetween, alike_shown, earlier, others
from openvima.policies.nn.frame_encoder import FrameEncoder
from openvima.policies.nn.meta_init import MetaInit
from openvima.policies.nn.object_encoder import ObjectEncoder, ObjectEncoderConfig
from openvima.policies.nn.prompt_encoder import PromptEncoder
from openvima.policies.nn.referents import referents
from openvima.policies.nn.trunk import TrunkState, build_trunk
from openvima.policies.tokenizer import PADDING_ID, texture_word_ids
from openvima.scene import END_EFFECTORS

NUM_END_EFFECTORS = len(END_EFFECTORS)
SUCTION = END_EFFECTORS.index("suction")


@dataclass(frozen=True, slots=True, eq=False)
class Memory:
    """Encoded prompts: what stays the same through an episode.

    Args:
        tokens_BLD: Encoded words and images.
        roles_BLD: The same, encoded without knowing what the objects look like; with word looks, neither from
            names of textures.
        mask_BL: Which places exist.
        object_mask_BL: Which of them are images, or words that refer to one.
        appearance_BLA: Appearance of their objects; zero elsewhere.
        sights: What the images show, shapes (B, M, ...), for networks that compare or copy.
        scenes: The same as the head needs it.
        word_looks_BLA: How what each word describes looks, for heads that copy; zero where none stands.
    """

    tokens_BLD: torch.Tensor
    roles_BLD: torch.Tensor
    mask_BL: torch.Tensor
    object_mask_BL: torch.Tensor
    appearance_BLA: torch.Tensor
    sights: Sights | None = None
    scenes: Remembered | None = None
    word_looks_BLA: torch.Tensor | None = None

    def select(self, rows: Sequence[int]) -> "Memory":
        """Return the prompts of some rows of the batch."""
        index = torch.as_tensor(rows, dtype=torch.int64, device=self.mask_BL.device)
        return Memory(
            self.tokens_BLD[index],
            self.roles_BLD[index],
            self.mask_BL[index],
            self.object_mask_BL[index],
            self.appearance_BLA[index],
            self.sights.select(rows) if self.sights else None,
            self.scenes.select(rows) if self.scenes else None,
            None if self.word_looks_BLA is None else self.word_looks_BLA[index],
        )


@dataclass(frozen=True, slots=True, eq=False)
class HistoryState:
    """What has been read of the histories of a batch; all are equally long.

    Args:
        trunk: What the trunk keeps.
        num_steps: Steps that were read.
        first: Objects in view at the first of them, for heads that copy.
    """

    trunk: TrunkState
    num_steps: int = 0
    first: Remembered | None = None

    def select(self, rows: Sequence[int]) -> "HistoryState":
        """Return the state of some rows of the batch."""
        first = self.first.select(rows) if self.first else None
        return HistoryState(self.trunk.select(rows), self.num_steps, first)


@dataclass(frozen=True, slots=True, eq=False)
class _Places:
    """Places of every step that follow each other in the history.

    Args:
        tokens_BTQD: What stands there.
        mask_BTQ: Which of them exist.
        kept_BTQ: Which of them are read: those that exist, and perhaps padding that the action is read from.
    """

    tokens_BTQD: torch.Tensor
    mask_BTQ: torch.Tensor
    kept_BTQ: torch.Tensor


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """What the images of prompts show.

    Args:
        order_BM: Where in the prompt each object stands.
        sights: Looks and places.
        changes_SD: What comparisons add to the token of each object of all prompts, if there are any.
        turns_BMR: Chances of the turns since an earlier image, if they are estimated.
    """

    order_BM: torch.Tensor
    sights: Sights
    changes_SD: torch.Tensor | None
    turns_BMR: torch.Tensor | None


class PolicyNetwork(nn.Module):
    """Multimodal prompt -> trunk over the history -> action head.

    "Put the {a} into the {b}." with one object in each image, two objects on the table, second step:

        prompt   [put, the, A, into, the, B, ., end]
        history  [obj, obj, query, action, obj, obj, query]
                             |                        |
                         1st action               2nd action

    The query is a learned token, or, as in the published policies, simply the last image token of the step.
    With an autoregressive head an action is twelve tokens, see `AutoregressiveHead`.
    """

    def __init__(self, config: PolicyConfig) -> None:
        super().__init__()
        width, images = config.trunk.width, config.images
        self.config = config
        self.images: ObjectEncoder | FrameEncoder = (
            ObjectEncoder(images) if isinstance(images, ObjectEncoderConfig) else FrameEncoder(images)
        )
        self.prompt = PromptEncoder(config.prompt, image_token_width=images.token_width, width=width)
        self.end_effectors = nn.Embedding(NUM_END_EFFECTORS, NUM_END_EFFECTORS)
        self.observation_out = nn.Linear(images.token_width + NUM_END_EFFECTORS, width)
        self.actions: ActionEncoder | ComponentTokens = (
            ComponentTokens(width, config.head.token_std)
            if isinstance(config.head, AutoregressiveConfig)
            else ActionEncoder(config.action_width, width)
        )
        self.trunk = build_trunk(config.trunk)
        self.query = nn.Parameter(torch.randn(width) * 0.02) if config.query_token else None
        self.head: ActionHead = _head(config)
        self.word_looks: nn.Linear | None = None
        if isinstance(self.head, CopyingHead):
            assert isinstance(images, ObjectEncoderConfig)  # the config has seen to it
            self.word_looks = nn.Linear(config.prompt.text.width, images.appearance_width, bias=False)
            nn.init.zeros_(self.word_looks.weight)
        self.compare_within: Comparison | None = None  # the prompt, or what is in view
        self.compare_with_prompt: Comparison | None = None
        if config.comparison:
            assert isinstance(images, ObjectEncoderConfig)  # the config has seen to it
            self.compare_within = Comparison(config.comparison, images)
            self.compare_with_prompt = Comparison(config.comparison, images)

    def encode_images(self, images: torch.Tensor) -> torch.Tensor:
        """Encode crops or frames of shape (..., 3, height, width), uint8, once each; features (..., F)."""
        return self.images.encode_images(images)

    def encode_prompts(self, prompts: PromptBatch, features_KF: torch.Tensor) -> Memory:
        """Encode prompts; needed once an episode.

        Args:
            prompts: The prompts.
            features_KF: Encoded images, by number.
        """
        features_VSF = features_KF[prompts.crop_index_VS]
        is_image_BL = (prompts.object_index_BL >= 0) & prompts.mask_BL
        describes_BL = self._describes(prompts.word_ids_BL)
        width = _appearance_width(self.config)
        looks_SA = features_VSF.new_zeros(prompts.masks_VS.shape[1], width)
        if width and len(looks_SA):
            assert isinstance(self.images, ObjectEncoder)
            looks_SA = self.images.embed_appearance(features_VSF, prompts.masks_VS)
        shown = None
        if self.compare_within or isinstance(self.head, CopyingHead):
            shown = self._shown(prompts, is_image_BL, features_VSF, looks_SA)
        changes_SD = None if shown is None else shown.changes_SD
        refers_BLL = None
        if self.config.prompt.referents:
            refers_BLL = referents(prompts.word_ids_BL, prompts.object_index_BL, prompts.mask_BL)
            refers_BLL = refers_BLL.to(features_VSF.dtype)
        encoded_BLD = self._read(prompts, features_VSF, changes_SD, refers_BLL)
        roles_BLD = encoded_BLD
        appearance_BLA = encoded_BLD.new_zeros(*is_image_BL.shape, width)
        if width:
            # Else a role could be told by which textures had it in training.
            word_ids_BL = torch.where(describes_BL, PADDING_ID, prompts.word_ids_BL)
            blind = replace(prompts, word_ids_BL=word_ids_BL)
            roles_BLD = self._read(blind, torch.zeros_like(features_VSF), changes_SD, refers_BLL)
            if len(looks_SA):
                appearance_BLA = looks_SA[prompts.object_index_BL.clamp(min=0)] * is_image_BL[..., None]
        shows_BL = is_image_BL
        if refers_BLL is not None:
            appearance_BLA = appearance_BLA + refers_BLL @ appearance_BLA
            shows_BL = is_image_BL | (refers_BLL > 0).any(dim=-1)
        memory = Memory(encoded_BLD, roles_BLD, prompts.mask_BL, shows_BL, appearance_BLA)
        if shown is None:
            return memory
        place_BMD = shown.order_BM[..., None].expand(-1, -1, encoded_BLD.shape[-1])
        scenes = _remembered(encoded_BLD.gather(1, place_BMD), shown.sights, shown.turns_BMR)
        scenes = replace(scenes, numbers_BK=_scene_numbers(shown.sights))
        word_looks_BLA = None
        if self.word_looks is not None:
            word_looks_BLA = self.word_looks(self.prompt.words(prompts.word_ids_BL)) * describes_BL[..., None]
        return replace(memory, sights=shown.sights, scenes=scenes, word_looks_BLA=word_looks_BLA)

    def begin(self, memory: Memory) -> HistoryState:
        """Return the state after the prompt and before the first step."""
        return HistoryState(self.trunk.begin(memory.tokens_BLD, memory.mask_BL))

    def forward(
        self, memory: Memory, history: HistoryBatch, features_KF: torch.Tensor, actions_BTC: torch.Tensor
    ) -> HeadInputs:
        """Read whole histories, for training.

        Args:
            memory: Encoded prompts.
            history: Observations.
            features_KF: Encoded images, by number.
            actions_BTC: Actions taken, metres and quaternions. What is told about one depends on earlier ones
                alone; with a token for each component also on the components before it.

        Returns:
            What the action head needs at every step.
        """
        if isinstance(self.actions, ComponentTokens):
            own = self._action_places(actions_BTC, history.steps_BT, features_KF.dtype)
            return self._read_steps(memory, self.begin(memory), history, features_KF, after=own)[0]
        previous_BTC = torch.cat([torch.zeros_like(actions_BTC[:, :1]), actions_BTC[:, :-1]], dim=1)
        has_previous_BT = F.pad(history.steps_BT[:, 1:], (1, 0), value=False)
        return self.extend(memory, self.begin(memory), history, features_KF, previous_BTC, has_previous_BT)[0]

    def extend(
        self,
        memory: Memory,
        state: HistoryState,
        history: HistoryBatch,
        features_KF: torch.Tensor,
        previous_BTC: torch.Tensor,
        has_previous_BT: torch.Tensor,
    ) -> tuple[HeadInputs, HistoryState]:
        """Read the next steps of histories; those before them are in the state.

        Args:
            memory: Encoded prompts.
            state: What has been read.
            history: Observations of the next steps.
            features_KF: Encoded images, by number.
            previous_BTC: The action that was taken before each of these observations, metres and quaternions.
            has_previous_BT: Whether there was one.

        Returns:
            What the action head needs at these steps, and the state after them.

        Raises:
            PolicyError: Prompt or history is longer than the trunk takes.
        """
        previous = self._action_places(previous_BTC, has_previous_BT, features_KF.dtype)
        inputs, state = self._read_steps(memory, state, history, features_KF, before=previous)
        return replace(inputs, previous_BTC=previous_BTC * has_previous_BT[..., None]), state

    def decide(self, inputs: HeadInputs, state: HistoryState, choose: Choose = likeliest) -> torch.Tensor:
        """Decide on the action of the step that was read last.

        Args:
            inputs: What `extend` returned for one step.
            state: The state after it, which stays as it is: the action that is then taken is read with the
                next observation.
            choose: How to choose between classes.

        Returns:
            Actions, shape (B, 1, 12), metres and quaternions, within bounds.
        """
        actions = self.actions
        if not isinstance(actions, ComponentTokens):
            return self.head.decide(inputs, choose)

        trunk = state.trunk

        def read_on(component: int, bins_B1: torch.Tensor) -> torch.Tensor:
            nonlocal trunk
            exists_B1 = torch.ones_like(bins_B1, dtype=torch.bool)
            output_B1D, trunk = self.trunk.extend(trunk, actions.of(component, bins_B1), exists_B1)
            return output_B1D

        return self.head.decide(inputs, choose, read_on)

    def _read_steps(
        self,
        memory: Memory,
        state: HistoryState,
        history: HistoryBatch,
        features_KF: torch.Tensor,
        *,
        before: _Places | None = None,
        after: _Places | None = None,
    ) -> tuple[HeadInputs, HistoryState]:
        """Read the slots of steps, and the places of actions before or after those of each step."""
        features = features_KF[history.crop_index_BTVN]
        appearance_BTNA = self._appearance(features, history.masks_BTVN)
        sights = _sights_in_view(history, features, appearance_BTNA, memory.sights)
        slots_BTQD, mask_BTQ, read_BT = self.observe(history, features, self._relations(memory, sights))
        metric = torch.promote_types(slots_BTQD.dtype, torch.float32)  # half precision: too coarse for metres
        # Masked places are left out, except the slot that is read: it is read even if it is padding.
        is_read_BTQ = F.one_hot(read_BT, mask_BTQ.shape[-1]).bool() & history.steps_BT[..., None]
        slots = _Places(slots_BTQD, mask_BTQ, mask_BTQ | is_read_BTQ)
        places = [part for part in (before, slots, after) if part is not None]
        outputs, trunk = self._read_on(state.trunk, places)
        outputs_BTQD = outputs[places.index(slots)]
        place_BT1D = read_BT[..., None, None].expand(-1, -1, 1, outputs_BTQD.shape[-1])
        query_BT1D = outputs_BTQD.gather(2, place_BT1D)
        objects_BTND = outputs_BTQD[:, :, :-1] if self.query is not None else outputs_BTQD
        first = state.first
        if first is None and isinstance(self.head, CopyingHead):
            first = _remembered(objects_BTND[:, 0], sights.at_step(0))
        state = HistoryState(trunk, state.num_steps + history.steps_BT.shape[1], first)
        inputs = HeadInputs(
            query_BTD=query_BT1D.squeeze(2),
            objects_BTND=objects_BTND,
            masks_BTN=history.masks_BTVN.any(dim=2),
            appearance_BTNA=appearance_BTNA,
            positions_BTN2=history.positions_BTN2.to(metric),
            grasps_BTN2=history.grasps_BTN2.to(metric),
            lifts_BT=history.end_effector_BT == SUCTION,
            prompt_BMD=memory.roles_BLD,
            prompt_masks_BM=memory.object_mask_BL,
            prompt_appearance_BMA=memory.appearance_BLA,
            # The first component is told at the query, each other one at the one before it.
            components_BTCD=torch.cat([query_BT1D, outputs[-1][:, :, :-1]], dim=2) if after else None,
            recollection=self._recollection(memory, state, history.steps_BT.shape[1]),
            word_looks_BMA=memory.word_looks_BLA,
            prompt_exists_BM=memory.mask_BL,
        )
        return inputs, state

    def observe(
        self,
        history: HistoryBatch,
        features_BTVNF: torch.Tensor,
        relations_BTND: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Make the slots of each step.

        Args:
            history: Observations.
            features_BTVNF: Encoded images of their objects.
            relations_BTND: What comparisons say of the objects, if there are any.

        Returns:
            Image tokens, then the query if there is one, (B, T, Q, D); which of them exist, (B, T, Q); and
            the slot from whose output the step's action is read, (B, T).
        """
        tokens_BTQE = self.images(features_BTVNF, history.boxes_BTVN4, history.masks_BTVN)
        if relations_BTND is not None:
            tokens_BTQE = tokens_BTQE + relations_BTND
        effector = self.end_effectors(history.end_effector_BT)[:, :, None]
        effector = effector.expand(*tokens_BTQE.shape[:3], NUM_END_EFFECTORS)
        slots_BTQD = self.observation_out(torch.cat([tokens_BTQE, effector], dim=-1))
        images = self.config.images
        if not isinstance(images, ObjectEncoderConfig):
            mask_BTQ = history.steps_BT[..., None].expand(slots_BTQD.shape[:3])
        elif images.fuse_views:
            mask_BTQ = history.masks_BTVN.any(dim=2)
        else:
            mask_BTQ = history.masks_BTVN.flatten(2)
        if self.query is not None:
            query_BT1D = self.query.expand(*slots_BTQD.shape[:2], 1, -1)
            slots_BTQD = torch.cat([slots_BTQD, query_BT1D], dim=2)
            mask_BTQ = torch.cat([mask_BTQ, history.steps_BT[..., None]], dim=2)
        read_BT = torch.full_like(history.num_slots_BT, slots_BTQD.shape[2] - 1)
        if self.query is None and isinstance(images, ObjectEncoderConfig):
            # The last slot of the episode itself, be it padding or not; beyond it lies padding of the batch.
            read_BT = read_BT - history.masks_BTVN.shape[-1] + history.num_slots_BT.clamp(min=1)
        return slots_BTQD, mask_BTQ, read_BT

    def _describes(self, word_ids_BL: torch.Tensor) -> torch.Tensor:
        """Which words say how something looks, (B, L): in our own vocabulary names of textures.

        Other words may not have looks: they would be those of what the training told of in such words.
        """
        if self.word_looks is None or self.config.prompt.tokenizer != "closed":
            return torch.zeros_like(word_ids_BL, dtype=torch.bool)
        return torch.isin(word_ids_BL, torch.tensor(sorted(texture_word_ids()), device=word_ids_BL.device))

    def _read(
        self,
        prompts: PromptBatch,
        features_VSF: torch.Tensor,
        changes_SD: torch.Tensor | None,
        refers_BLL: torch.Tensor | None,
    ) -> torch.Tensor:
        tokens_IE = self.images(features_VSF, prompts.boxes_VS4, prompts.masks_VS)
        if changes_SD is not None:
            tokens_IE = tokens_IE + changes_SD
        return self.prompt(
            prompts.word_ids_BL, prompts.object_index_BL, prompts.mask_BL, tokens_IE, refers_BLL
        )

    def _shown(
        self,
        prompts: PromptBatch,
        is_image_BL: torch.Tensor,
        features_VSF: torch.Tensor,
        looks_SA: torch.Tensor,
    ) -> _Shown:
        """Gather what prompts show, and compare the objects of each with those of its earlier images."""
        order_BM = _objects_first(is_image_BL)
        exists_BM = is_image_BL.gather(1, order_BM)
        row_BM = prompts.object_index_BL.gather(1, order_BM).clamp(min=0)
        sights = _sights_of(prompts, row_BM, exists_BM, features_VSF, looks_SA)
        if self.compare_within is None:
            return _Shown(order_BM, sights, None, None)
        changes_BMD, turns_BMR = self.compare_within(
            sights, sights, earlier(sights) & alike_shown(sights), self._turn_between
        )
        changes_SD = changes_BMD.new_zeros(prompts.masks_VS.shape[1], changes_BMD.shape[-1])
        changes_SD = changes_SD.index_put((row_BM[exists_BM],), changes_BMD[exists_BM])
        return _Shown(order_BM, sights, changes_SD, turns_BMR)

    def _relations(self, memory: Memory, sights: Sights) -> torch.Tensor | None:
        """Compare the objects in view with each other and with those of the prompt, (B, T, N, D)."""
        if self.compare_within is None or self.compare_with_prompt is None or memory.sights is None:
            return None
        shown, turns = memory.sights.at_each_step(), self._turn_between
        within_BTND, _ = self.compare_within(sights, sights, others(sights), turns)
        prompt_BTND, _ = self.compare_with_prompt(sights, shown, earlier(sights, shown), turns)
        return within_BTND + prompt_BTND

    @property
    def _turn_between(self) -> TurnBetween | None:
        images = self.images
        if isinstance(images, ObjectEncoder) and images.config.turn_bins:
            return images.turn_between
        return None

    def _recollection(self, memory: Memory, state: HistoryState, num_steps: int) -> Recollection | None:
        """What a head may copy from at the steps that were read last."""
        if memory.scenes is None or state.first is None:
            return None
        device = memory.mask_BL.device
        steps_T = torch.arange(state.num_steps - num_steps, state.num_steps, device=device)
        return Recollection(state.first, memory.scenes, steps_T)

    def _action_places(
        self, actions_BTC: torch.Tensor, exists_BT: torch.Tensor, dtype: torch.dtype
    ) -> _Places:
        """Make the token of each action, or the tokens of its components."""
        # Bins need all digits, whatever the network computes in.
        unit_BTC = self.head.as_history(to_unit_range(actions_BTC.to(torch.float64)))
        if isinstance(self.actions, ComponentTokens):
            tokens_BTQD = self.actions(unit_BTC)
        else:
            tokens_BTQD = self.actions(unit_BTC.to(dtype))[:, :, None]
        mask_BTQ = exists_BT[..., None].expand(tokens_BTQD.shape[:3])
        return _Places(tokens_BTQD, mask_BTQ, mask_BTQ)

    def _read_on(
        self, state: TrunkState, places: Sequence[_Places]
    ) -> tuple[tuple[torch.Tensor, ...], TrunkState]:
        """Put all places of each step in a row, and the steps one after the other, and read them.

        Returns:
            For each of the places the outputs, (B, T, Q, D), zero at those that are not read; and the state.
        """
        sizes = [part.tokens_BTQD.shape[2] for part in places]
        sequence_BLD = torch.cat([part.tokens_BTQD for part in places], dim=2).flatten(1, 2)
        mask_BL = torch.cat([part.mask_BTQ for part in places], dim=2).flatten(1)
        kept_BTQ = torch.cat([part.kept_BTQ for part in places], dim=2)
        kept_BL = kept_BTQ.flatten(1)
        order_BP = kept_BL.to(torch.int8).argsort(dim=1, descending=True, stable=True)
        order_BP = order_BP[:, : int(kept_BL.sum(dim=1).max())]
        places_BPD = order_BP[..., None].expand(-1, -1, sequence_BLD.shape[-1])
        read_BPD, state = self.trunk.extend(
            state,
            sequence_BLD.gather(1, places_BPD),
            mask_BL.gather(1, order_BP),
            kept_BL.gather(1, order_BP),
        )
        outputs_BLD = read_BPD.new_zeros(sequence_BLD.shape).scatter(1, places_BPD, read_BPD)
        return outputs_BLD.unflatten(1, kept_BTQ.shape[1:]).split(sizes, dim=2), state

    def _appearance(self, features_BTVNF: torch.Tensor, masks_BTVN: torch.Tensor) -> torch.Tensor:
        if _appearance_width(self.config):
            assert isinstance(self.images, ObjectEncoder)
            return self.images.embed_appearance(features_BTVNF, masks_BTVN)
        return features_BTVNF.new_zeros(*masks_BTVN.any(dim=2).shape, 0)


def build_network(config: PolicyConfig, *, seed: int) -> PolicyNetwork:
    """Build a network with fresh weights that follow from the seed; global random state stays as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PolicyNetwork(config)


def outline_network(config: PolicyConfig) -> PolicyNetwork:
    """Build a network without weights: names and shapes, to count them or to put weights in their place.

    It takes no time and no memory, whatever the sizes. `network.load_state_dict(weights, assign=True)` makes
    a whole network of it.
    """
    with MetaInit():
        return PolicyNetwork(config)


def _objects_first(is_image_BL: torch.Tensor) -> torch.Tensor:
    """Places of the objects of each prompt, in reading order, then some others, (B, M)."""
    order_BL = is_image_BL.to(torch.int8).argsort(dim=1, descending=True, stable=True)
    return order_BL[:, : int(is_image_BL.sum(dim=1).max())]


def _sights_of(
    prompts: PromptBatch,
    row_BM: torch.Tensor,
    exists_BM: torch.Tensor,
    features_VSF: torch.Tensor,
    looks_SA: torch.Tensor,
) -> Sights:
    """What the objects of each prompt look like and where they are."""
    metric = torch.promote_types(features_VSF.dtype, torch.float32)
    return Sights(
        features_VNF=features_VSF[:, row_BM].transpose(0, 1),
        boxes_VN4=prompts.boxes_VS4[:, row_BM].transpose(0, 1),
        masks_VN=(prompts.masks_VS[:, row_BM] & exists_BM).transpose(0, 1),
        appearance_NA=looks_SA[row_BM],
        positions_N2=prompts.positions_S2[row_BM].to(metric),
        on_table_N=prompts.in_scene_S[row_BM] & exists_BM,
        numbers_N=prompts.image_index_S[row_BM] * exists_BM,
    )


def _sights_in_view(
    history: HistoryBatch,
    features_BTVNF: torch.Tensor,
    appearance_BTNA: torch.Tensor,
    prompt: Sights | None,
) -> Sights:
    """What the objects in view look like and where they are; their time is after the prompt's last image."""
    exists_BTN = history.masks_BTVN.any(dim=2)
    now_BTN = torch.zeros_like(exists_BTN, dtype=torch.int64)
    if prompt is not None and prompt.numbers_N.shape[1]:
        now_BTN = now_BTN + (prompt.numbers_N.amax(dim=1) + 1)[:, None, None]
    metric = torch.promote_types(features_BTVNF.dtype, torch.float32)
    return Sights(
        features_BTVNF,
        history.boxes_BTVN4,
        history.masks_BTVN,
        appearance_BTNA,
        history.positions_BTN2.to(metric),
        exists_BTN,
        now_BTN,
    )


def _remembered(
    tokens_BKD: torch.Tensor, sights: Sights, turns_BKR: torch.Tensor | None = None
) -> Remembered:
    """Keep objects as places to copy."""
    return Remembered(
        tokens_BKD,
        sights.masks_VN.any(dim=-2) & sights.on_table_N,
        sights.appearance_NA,
        sights.positions_N2,
        sights.numbers_N,
        turns_BKR,
    )


def _scene_numbers(sights: Sights) -> torch.Tensor:
    """Number of the picture of the table that shows each object, (B, M); others do not count."""
    numbers_BM = sights.numbers_N
    is_next_BM = numbers_BM != F.pad(numbers_BM[:, :-1], (1, 0), value=-1)
    return ((is_next_BM & sights.on_table_N).cumsum(dim=1) - 1).clamp(min=0)


def _appearance_width(config: PolicyConfig) -> int:
    return config.images.appearance_width if isinstance(config.images, ObjectEncoderConfig) else 0


def _head(config: PolicyConfig) -> ActionHead:
    width, head = config.trunk.width, config.head
    if isinstance(head, AutoregressiveConfig):
        return AutoregressiveHead(head, width)
    if isinstance(head, CopyingConfig):
        assert isinstance(config.images, ObjectEncoderConfig)  # the config has seen to it
        images = config.images
        return CopyingHead(head, width, images.turn_bins if config.comparison else 0)
    return BinsHead(head, width) if isinstance(head, BinsConfig) else PointingHead(head, width)
