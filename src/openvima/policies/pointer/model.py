"""The pointer models: they point at objects instead of regressing coordinates.

Shape suffixes: B batch, T steps, L prompt positions, I image tokens of all prompts, S objects in all
prompts, M objects in one prompt, V views, N objects in view, Q tokens of a step, K images, F width of image
features, A width of appearance, D width of the decoder, C components of an action, R bins of rotations.
"""

from dataclasses import dataclass, replace

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.batch import HistoryBatch, PromptBatch
from openvima.policies.nn.action_head import (
    action_segment,
    shift_actions,
)
from openvima.policies.nn.actions import ActionEncoder, ActionTargets, DecodingStrategy, greedy, to_unit_range
from openvima.policies.nn.decoder import KVCache, TokenSegment, build_decoder
from openvima.policies.nn.layers import TensorRecord, map_tensors, valid_first
from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.policies.nn.policy_network import (
    NUM_END_EFFECTORS,
    Decoded,
    PolicyNetwork,
    StepInputs,
    StepTrace,
)
from openvima.policies.nn.prompt_encoder import PromptEncoder
from openvima.policies.pointer.candidate_head import CandidatePointerHead
from openvima.policies.pointer.config import CandidateHeadConfig, PointerConfig
from openvima.policies.pointer.correspondence import (
    Correspondence,
    ObjectFeatures,
    in_earlier_image,
)
from openvima.policies.pointer.inputs import HeadInputs, ObjectSet, PointerPrompt
from openvima.policies.pointer.object_head import ObjectPointerHead
from openvima.policies.pointer.words import Attributes, Coreference, coreference
from openvima.policies.tokenizer import PADDING_ID
from openvima.scene import END_EFFECTORS

SUCTION = END_EFFECTORS.index("suction")


@dataclass(frozen=True, slots=True, eq=False)
class DecodingState(TensorRecord):
    """What is known of the steps so far.

    Args:
        cache: Keys and values.
        num_steps: Number of steps, the same for all episodes.
        first_step: Objects in view at the first of them; None before it.
    """

    cache: KVCache
    num_steps: int = 0
    first_step: ObjectSet | None = None


class Pointer(PolicyNetwork):
    """Fused object tokens, cross-attention to the prompt, and a head that points.

    "Put the {a} into the {b}." with one object in each image, two objects on the table, second step:

        prompt   [put, the, A, into, the, B, ., end]
        history  [obj, obj, query, action, obj, obj, query]
                             |                        |
                         1st action               2nd action

    The prompt is encoded twice, once with appearance masked: that encoding tells roles. Appearance
    embeddings, pretrained by contrast, then match prompt objects with objects in view.
    """

    explains = True

    def __init__(self, config: PointerConfig) -> None:
        super().__init__()
        width, images, words = config.decoder.width, config.images, config.prompt.text.width
        self.config = config
        self.images = ObjectEncoder(images)
        self.prompt = PromptEncoder(config.prompt, image_token_width=images.width, width=width)
        self.coreference = Coreference(words) if config.coreference else None
        self.end_effectors = nn.Embedding(NUM_END_EFFECTORS, NUM_END_EFFECTORS)
        self.observation_out = nn.Linear(images.width + NUM_END_EFFECTORS, width)
        self.actions = ActionEncoder(config.action_width, width)
        self.decoder = build_decoder(config.decoder)
        self.query = nn.Parameter(torch.randn(width) * 0.02)
        self.text_appearance: nn.Linear | None = None
        if isinstance(config.head, CandidateHeadConfig):
            rotation_bins = images.rotation_bins if config.correspondence else 0
            self.head = CandidatePointerHead(config.head, width, rotation_bins, config.attributes)
            joined_width = Attributes.joined_width(config.attributes) if config.attributes else 0
            self.text_appearance = nn.Linear(words, images.appearance_width + joined_width, bias=False)
            nn.init.zeros_(self.text_appearance.weight)
        else:
            self.head = ObjectPointerHead(config.head, width)
        if config.correspondence:
            self.correspondence = Correspondence(config.correspondence, images)  # within prompt, or view
            self.prompt_correspondence = Correspondence(config.correspondence, images)  # from view to prompt
        self.attributes: Attributes | None = None
        if config.attributes:
            self.attributes = Attributes(config.attributes, images, config.prompt.vocabulary_size)

    def encode_prompt(self, prompts: PromptBatch, features_KF: torch.Tensor) -> PointerPrompt:
        """Encode prompts with and without appearance, and gather their objects.

        An object has three numbers: its row among the objects of the batch (S), which the object encoder
        reads; its place among the objects of its prompt in reading order (M), by which objects are compared;
        and the position of its token (L). `row_BM` and `order_BM` lead from M to S and to L. Where
        `exists_BM` is False they name something else, so what is written through them is masked first. No
        object has two tokens, so that nothing is written twice.
        """
        features_VSF = features_KF[prompts.crop_index_VS]
        is_image_BL = (prompts.object_index_BL >= 0) & prompts.mask_BL
        appearance_SA = self.embed_appearance(features_VSF, prompts.boxes_VS4, prompts.masks_VS)
        order_BM = valid_first(is_image_BL)
        exists_BM = is_image_BL.gather(1, order_BM)
        row_BM = prompts.object_index_BL.gather(1, order_BM).clamp(min=0)
        objects = _prompt_objects(prompts, row_BM, exists_BM, features_VSF, appearance_SA)
        # From words to the images that defined them: "This is a wug {image}. Put the wug …"
        weights_BLL = coreference(prompts).to(features_VSF.dtype)
        compared, selected_BP, attributes_BMX = objects, None, None
        if self.attributes is not None:
            # Likeness alone is to decide: neither the name of the attribute nor what else the objects share.
            selected_BP, names_attribute_BL = self.attributes.selected(prompts)
            attributes_BMX = self.attributes.embed(objects, selected_BP) * exists_BM[..., None]
            word_ids_BL = prompts.word_ids_BL.masked_fill(names_attribute_BL, PADDING_ID)
            prompts = replace(prompts, word_ids_BL=word_ids_BL)
            compared = self.attributes.hide_others(objects, selected_BP, attributes_BMX)
            is_shown_BM = ~selected_BP.any(dim=1)[:, None].expand_as(row_BM)
            is_shown_S = torch.ones_like(prompts.in_scene_S)
            is_shown_S = is_shown_S.index_put((row_BM[exists_BM],), is_shown_BM[exists_BM])
            features_VSF = features_VSF * is_shown_S[:, None]
        changes_BMD, rotations_BMR = self._changes_in_prompt(compared)
        changes_SD = changes_BMD.new_zeros(prompts.masks_VS.shape[1], self.config.images.width)
        changes_SD = changes_SD.index_put((row_BM[exists_BM],), changes_BMD[exists_BM])
        describes_BL = prompts.names_texture_BL & (self.text_appearance is not None)
        tokens_BLD, masked_BLD = self._encode(prompts, describes_BL, features_VSF, changes_SD, weights_BLL)
        # Heads attend over positions. A word stands for the images that it refers to: their sum of weight 1.
        appearance_BLA = tokens_BLD.new_zeros(*is_image_BL.shape, appearance_SA.shape[-1])
        if len(appearance_SA):
            appearance_BLA = appearance_SA[prompts.object_index_BL.clamp(min=0)] * is_image_BL[..., None]
        attributes_BLX, object_mask_BL = None, is_image_BL
        if attributes_BMX is not None:
            attributes_BLX = attributes_BMX.new_zeros(*is_image_BL.shape, attributes_BMX.shape[-1])
            position_BMX = order_BM[..., None].expand_as(attributes_BMX)
            attributes_BLX = attributes_BLX.scatter(1, position_BMX, attributes_BMX)
        if self.coreference is not None:
            appearance_BLA = appearance_BLA + weights_BLL @ appearance_BLA
            object_mask_BL = is_image_BL | (weights_BLL > 0).any(dim=-1)
            if attributes_BLX is not None:
                attributes_BLX = attributes_BLX + weights_BLL @ attributes_BLX
        described_BLA = torch.zeros_like(appearance_BLA)
        if self.text_appearance is not None:
            # Other words describe none: it would be that of the objects they occurred with in training.
            words_BLW = self.prompt.words(prompts.word_ids_BL)
            described_BLA = self.text_appearance(words_BLW) * describes_BL[..., None]
        index_BMD = order_BM[..., None].expand(-1, -1, tokens_BLD.shape[-1])
        object_set = ObjectSet.of(tokens_BLD.gather(1, index_BMD), objects, rotations_BMR)
        return PointerPrompt(
            tokens_BLD,
            masked_BLD,
            prompts.mask_BL,
            object_mask_BL,
            appearance_BLA,
            described_BLA,
            compared,
            replace(object_set, image_index_BK=_scene_index(objects)),
            selected_BP,
            attributes_BLX,
            describes_BL if self.training or describes_BL.any() else None,
        )

    def fit_prior(self, actions_NC: torch.Tensor) -> None:
        """Leave the head as it is: candidates differ from demonstration to demonstration."""

    def init_cache(self, prompt: PointerPrompt) -> DecodingState:
        """Return the state of decoding after the prompt and before the first step."""
        return DecodingState(self.decoder.init_cache(prompt.tokens_BLD, prompt.mask_BL))

    def loss(
        self, prompt: PointerPrompt, history: HistoryBatch, features_KF: torch.Tensor, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Decode whole histories and compare with what was demonstrated."""
        step = StepInputs(prompt, self.init_cache(prompt), history, features_KF, *shift_actions(targets))
        return self.head.loss(self._head_inputs(step)[0], targets)

    def decode_step(
        self, step: StepInputs, strategy: DecodingStrategy = greedy
    ) -> tuple[torch.Tensor, DecodingState]:
        """Decode the actions of the next steps, of which the earlier ones are in the state."""
        inputs, state = self._head_inputs(step)
        return self.head.decode(inputs, strategy), state

    def explain_step(self, step: StepInputs, decoded: Decoded) -> StepTrace:
        """Explain what was decoded in one step."""
        return self.head.trace(self._head_inputs(step)[0], decoded)

    def _head_inputs(self, step: StepInputs) -> tuple[HeadInputs, DecodingState]:
        """Decode steps of a previous action and an observation each."""
        prompt, state, history, features_KF = step.prompt, step.state, step.history, step.features_KF
        features_BTVNF = features_KF[history.crop_index_BTVN]
        appearance_BTNA = self.embed_appearance(features_BTVNF, history.boxes_BTVN4, history.masks_BTVN)
        objects = _objects_in_view(history, features_BTVNF, appearance_BTNA, prompt.features)
        compared, attributes_BTNX, selected_BP = objects, None, prompt.selected_BP
        # Most prompts select none; in training their gradients are zero, which is not the same as none.
        has_selected = selected_BP is not None and (self.training or bool(selected_BP.any()))
        if self.attributes is not None and selected_BP is not None and has_selected:
            attributes_BTNX = self.attributes.embed(objects, selected_BP)
            compared = self.attributes.hide_others(objects, selected_BP, attributes_BTNX)
        changes_BTND, rotations_BTNR = self._changes_in_view(compared, prompt)
        observed = self._observation_segment(history, compared, changes_BTND)
        actions_BTC = to_unit_range(step.previous_BTC.to(torch.float64)).to(features_KF.dtype)
        previous = action_segment(self.actions(actions_BTC)[:, :, None], step.has_previous_BT)
        (_, outputs_BTQD), cache = self.decoder.decode_segments(state.cache, [previous, observed])
        objects_BTND = outputs_BTQD[:, :, :-1]  # the last token of a step is its query
        num_steps, first_step = history.steps_BT.shape[1], state.first_step
        if first_step is None:
            now = map_tensors(objects, lambda tensor: tensor[:, 0])
            first_step = ObjectSet.of(objects_BTND[:, 0], now, now.appearance_NA[..., :0])
        steps_BT = state.num_steps + torch.arange(num_steps, device=prompt.mask_BL.device)[None]
        inputs = HeadInputs(
            query_BTD=outputs_BTQD[:, :, -1].contiguous(),  # as linear layers take it fastest
            objects_BTND=objects_BTND,
            masks_BTN=objects.exists_N,
            appearance_BTNA=appearance_BTNA,
            positions_BTN2=objects.positions_N2,
            grasps_BTN2=history.grasps_BTN2.to(objects.positions_N2.dtype),
            has_suction_BT=history.end_effector_BT == SUCTION,
            previous_BTC=step.previous_BTC * step.has_previous_BT[..., None],
            steps_BT=steps_BT,
            first_step=first_step,
            prompt=prompt,
            rotations_BTNR=rotations_BTNR,
            attributes_BTNX=attributes_BTNX,
        )
        return inputs, DecodingState(cache, state.num_steps + num_steps, first_step)

    def embed_appearance(
        self, features_VNF: torch.Tensor, boxes_VN4: torch.Tensor, masks_VN: torch.Tensor
    ) -> torch.Tensor:
        """Unit vectors by which objects are matched, (..., N, A)."""
        appearance_NA = self.images.embed_appearance(features_VNF, masks_VN)
        if self.attributes is None:
            return appearance_NA
        return self.attributes.with_appearance(appearance_NA, features_VNF, boxes_VN4, masks_VN)

    def _observation_segment(
        self, history: HistoryBatch, objects: ObjectFeatures, changes_BTND: torch.Tensor
    ) -> TokenSegment:
        """Return the tokens of the objects in view, and a learned query behind them."""
        tokens_BTNE = self.images(objects.features_VNF, objects.boxes_VN4, objects.masks_VN) + changes_BTND
        tokens_BTND = self.add_end_effector(tokens_BTNE, history.end_effector_BT)
        query_BT1D = self.query.expand(*tokens_BTND.shape[:2], 1, -1)
        mask_BTQ = torch.cat([objects.exists_N, history.steps_BT[..., None]], dim=2)
        return TokenSegment(torch.cat([tokens_BTND, query_BT1D], dim=2), mask_BTQ, mask_BTQ)

    def _encode(
        self,
        prompts: PromptBatch,
        describes_BL: torch.Tensor,
        features_VSF: torch.Tensor,
        changes_SD: torch.Tensor,
        weights_BLL: torch.Tensor,
    ) -> tuple[torch.Tensor, ...]:
        """Encode prompts, and in the same batch without crops and the words that describe appearance."""
        tokens_IE = torch.cat(
            [
                self.images(each_VSF, prompts.boxes_VS4, prompts.masks_VS) + changes_SD
                for each_VSF in (features_VSF, torch.zeros_like(features_VSF))
            ]
        )
        word_ids_BL, object_index_BL = prompts.word_ids_BL, prompts.object_index_BL
        masked_ids_BL = word_ids_BL.masked_fill(describes_BL, PADDING_ID)
        masked_index_BL = object_index_BL + (object_index_BL >= 0) * len(changes_SD)
        both = replace(
            prompts,
            word_ids_BL=torch.cat([word_ids_BL, masked_ids_BL]),
            object_index_BL=torch.cat([object_index_BL, masked_index_BL]),
            mask_BL=prompts.mask_BL.repeat(2, 1),
        )
        tokens_BLW, images_BLW = self.prompt.embed(both, tokens_IE)
        if self.coreference is not None:
            tokens_BLW = self.coreference(tokens_BLW, images_BLW, weights_BLL.repeat(2, 1, 1))
        return self.prompt.encode(tokens_BLW, images_BLW, both.mask_BL).chunk(2)

    def _changes_in_prompt(self, objects: ObjectFeatures) -> tuple[torch.Tensor, torch.Tensor]:
        """Compare objects with those of earlier images: changes of tokens, (B, M, D), and rotations."""
        if not self.config.correspondence:
            none_BM = objects.appearance_NA.new_zeros(*objects.image_index_N.shape, self.config.images.width)
            return none_BM, none_BM[..., :0]
        # Scenes and objects alone are kept apart.
        same_kind = objects.in_scene_N[..., None, :] == objects.in_scene_N[..., :, None]
        allowed = in_earlier_image(objects, objects) & same_kind
        return self.correspondence(objects, objects, allowed, self.images.rotation_between)

    def _changes_in_view(
        self, objects: ObjectFeatures, prompt: PointerPrompt
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Compare objects in view with each other and with those of the prompt.

        Returns:
            Changes of tokens, (B, T, N, D), and `HeadInputs.rotations_BTNR`.
        """
        if not (sizes := self.config.correspondence):
            return objects.appearance_NA.new_zeros(()), objects.appearance_NA[..., :0]
        shown, rotation_between = prompt.features, self.images.rotation_between
        shown = map_tensors(shown, lambda tensor: tensor.unsqueeze(1))  # the same at each step
        # Further columns are zero where no prompt selects attributes.
        width = objects.appearance_NA.shape[-1]
        shown = replace(shown, appearance_NA=shown.appearance_NA[..., :width])
        allowed = in_earlier_image(objects, shown)
        changes_BTND, since_BTNR = self.prompt_correspondence(objects, shown, allowed, rotation_between)
        if sizes.within_view:
            count = objects.image_index_N.shape[-1]
            others = ~torch.eye(count, dtype=torch.bool, device=changes_BTND.device)
            changes_BTND = self.correspondence(objects, objects, others, rotation_between)[0] + changes_BTND
        # Bin k of the inverse rotation is bin R - k.
        return changes_BTND, since_BTNR.flip(-1).roll(1, dims=-1)


def _prompt_objects(
    prompts: PromptBatch,
    row_BM: torch.Tensor,
    exists_BM: torch.Tensor,
    features_VSF: torch.Tensor,
    appearance_SA: torch.Tensor,
) -> ObjectFeatures:
    """Gather the objects of each prompt."""
    metric = torch.promote_types(features_VSF.dtype, torch.float32)  # half precision is too coarse for metres
    return ObjectFeatures(
        features_VNF=features_VSF[:, row_BM].transpose(0, 1),
        boxes_VN4=prompts.boxes_VS4[:, row_BM].transpose(0, 1),
        masks_VN=(prompts.masks_VS[:, row_BM] & exists_BM).transpose(0, 1),
        appearance_NA=appearance_SA[row_BM],
        positions_N2=prompts.positions_S2[row_BM].to(metric),
        in_scene_N=prompts.in_scene_S[row_BM] & exists_BM,
        image_index_N=prompts.image_index_S[row_BM] * exists_BM,
    )


def _objects_in_view(
    history: HistoryBatch, features_BTVNF: torch.Tensor, appearance_BTNA: torch.Tensor, prompt: ObjectFeatures
) -> ObjectFeatures:
    """Gather the objects in view; their image index comes after the prompt's last."""
    exists_BTN = history.masks_BTVN.any(dim=2)
    last_B = F.pad(prompt.image_index_N, (1, 0), value=-1).amax(dim=1)
    metric = torch.promote_types(features_BTVNF.dtype, torch.float32)
    return ObjectFeatures(
        features_BTVNF,
        history.boxes_BTVN4,
        history.masks_BTVN,
        appearance_BTNA,
        history.positions_BTN2.to(metric),
        exists_BTN,
        (last_B + 1)[:, None, None].expand_as(exists_BTN),
    )


def _scene_index(objects: ObjectFeatures) -> torch.Tensor:
    """Index of the scene that shows each object among the scenes of its prompt, (B, M)."""
    image_index_BM = objects.image_index_N
    is_next_BM = image_index_BM != F.pad(image_index_BM[:, :-1], (1, 0), value=-1)
    return ((is_next_BM & objects.in_scene_N).cumsum(dim=1) - 1).clamp(min=0)
