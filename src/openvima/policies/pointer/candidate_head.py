"""The head of `small`: point at an object and at a place candidate, which may be a place seen before.

"Rearrange to this {scene} and then restore." asks for places where nothing is now. One of them is where the
prompt shows the object, the other one where it was at the first step.

Shape suffixes as in `inputs.py`; C candidates, E kinds of them, G geometric features, H prompt queries
(in `hidden_BTH` the hidden width).
"""

import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.nn.actions import (
    ActionTargets,
    DecodingStrategy,
    at,
    greedy,
    mask_scores,
    masked_mean,
    nll,
    rotate,
    yaw_between,
)
from openvima.policies.nn.layers import mlp
from openvima.policies.nn.policy_network import Decoded, StepTrace, normalize_weights
from openvima.policies.pointer.candidates import (
    NUM_GEOMETRY,
    GridCandidates,
    PlaceCandidates,
    distances,
    products,
    proximity,
)
from openvima.policies.pointer.config import AttributeConfig, CandidateHeadConfig
from openvima.policies.pointer.inputs import (
    OFFSET_UNIT_M,
    HeadInputs,
    PointerPrompt,
    accuracy,
    bin_to_yaw,
    demonstrated_place,
    offset_loss,
    pick_and_place,
    pointing_metrics,
    yaw_to_bin,
)
from openvima.policies.pointer.object_head import ObjectPointer, sum_losses
from openvima.policies.pointer.words import TextGrounding, attention_scores
from openvima.scene.explanation import PLACE_KINDS

_ON_TOP_M = 0.04  # scale within which an object is in or on another one
_MAX_DISTANCE = 10.0  # in units of offsets; larger distances are clipped
_SAME_APPEARANCE = 0.7  # cosine from which on two images are taken to show one object
_ROTATION_SCALE = 5.0  # initial logit of a rotation that is certain


class CandidatePointerHead(nn.Module):
    """Points at the object to pick, then at a place candidate; offset and yaw are relative to it.

    Candidates, with two objects on the table and one in the only scene of the prompt:

        [1 in view, 2 in view, 1 at first step, 2 at first step, 1 in the prompt, grid 1, …, grid 32]

    Objects that only have to be cleared away go to a grid point: a demonstration chooses one of many places
    that would do, whose mean would not. The centre of the picked object goes to the candidate's, plus the
    offset. The grasp and the rotation then determine the pose of the tool, so that a wrong rotation does not
    move the object.

    Rotations are copied as well, where the model estimates them in as many bins as the head has: those
    between prompt images, and that of the picked object to how the prompt shows it.
    """

    def __init__(
        self,
        config: CandidateHeadConfig,
        width: int,
        rotation_bins: int = 0,
        attributes: AttributeConfig | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        copies_rotations = rotation_bins == config.num_yaw_bins
        self.rotation_copy = RotationCopy(width, config.hidden_width) if copies_rotations else None
        self.pick = PickPointer(config, width, attributes)
        self.place = PlacePointer(config, width)
        self.grid = GridCandidates(width)
        self.values = nn.ModuleList(nn.Linear(width, width) for _ in PLACE_KINDS)
        self.relation = mlp((3 * width + 8, config.hidden_width, config.hidden_width))
        self.offset = nn.Linear(config.hidden_width, 2)
        self.yaw = nn.Linear(config.hidden_width, config.num_yaw_bins)
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.offset.bias)

    def loss(
        self, inputs: HeadInputs, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Cross-entropy of both pointers, also by appearance alone, and of the yaw; Huber loss of the offset.

        The loss is that of the total probability of all right candidates, see `PlaceCandidates.right`. From a
        named object that is not at the demonstrated place the offset has to lead there. Metrics leave out a
        step for which only a grid point is right.
        """
        candidates, config = self.candidates(inputs), self.config
        # The pick is teacher-forced: the place is that of the object that the demonstration picked. Slots of
        # -1 are clamped, so that they can be gathered, and masked in the losses.
        has_pick, pick = targets.steps_BT & (targets.pick_BT >= 0), targets.pick_BT.clamp(min=0)
        pick_logits, place_logits = self.pick(inputs), self.place(inputs, candidates, pick)
        goal = demonstrated_place(inputs, targets, inputs.positions_BTN2, pick)
        right_BTC, has_place_BT = candidates.right(targets, goal)
        right_BTC = right_BTC | ~has_pick[..., None]  # else no logit would be left, and the loss infinite
        right_logits = mask_scores(place_logits, right_BTC)
        place = right_logits.argmax(-1)  # of the right ones that with the highest logit
        offset, yaw_logits = self.relate(inputs, candidates, pick, place)
        true_offset = goal - at(candidates.positions_BTC2, place)
        yaw = yaw_to_bin(yaw_between(targets.actions_BTC), config.num_yaw_bins)
        place_nll = place_logits.logsumexp(-1) - right_logits.logsumexp(-1)
        pick_appearance = self.pick.appearance_scores(inputs)
        grounding, is_grounded_BT = self.pick.grounding_nll(inputs, pick)
        has_other = has_pick & (targets.place_BT >= 0) & (targets.place_BT != pick)
        place_appearance = self.place.appearance_scores(inputs, pick)
        other = targets.place_BT.clamp(min=0)
        appearance_weight = config.appearance_loss_weight
        losses = {
            "pick": masked_mean(nll(pick_logits, pick), has_pick),
            "pick_appearance": masked_mean(nll(pick_appearance, pick), has_pick) * appearance_weight,
            "grounding": masked_mean(grounding, has_pick & is_grounded_BT) * config.grounding_loss_weight,
            "place_appearance": masked_mean(nll(place_appearance, other), has_other) * appearance_weight,
            "place": masked_mean(place_nll, has_pick),
            "offset": masked_mean(offset_loss(offset, true_offset), has_pick) * config.offset_weight,
            "yaw": masked_mean(nll(yaw_logits, yaw), has_pick) * config.yaw_weight,
        }
        metrics = pointing_metrics(
            (pick_logits, place_logits, yaw_logits),
            (pick, place, yaw),
            offset - true_offset,
            has_pick,
            has_pick & has_place_BT,
        )
        metrics["appearance_accuracy"] = accuracy(pick_appearance, pick, has_pick)
        return sum_losses(losses, metrics)

    def decode(self, inputs: HeadInputs, strategy: DecodingStrategy = greedy) -> torch.Tensor:
        """Pick an object, and bring its centre to a candidate; actions (B, T, 12)."""
        candidates = self.candidates(inputs)
        pick = strategy(self.pick(inputs))
        place = strategy(self.place(inputs, candidates, pick))
        offset, yaw_logits = self.relate(inputs, candidates, pick, place)
        offset = offset.to(inputs.positions_BTN2.dtype)  # half precision is too coarse for metres and radians
        yaw = bin_to_yaw(strategy(yaw_logits), self.config.num_yaw_bins, offset.dtype)
        goal, grasp = at(candidates.positions_BTC2, place) + offset, at(inputs.grasps_BTN2, pick)
        held = rotate(grasp - at(inputs.positions_BTN2, pick), yaw)
        return pick_and_place(grasp, torch.where(inputs.has_suction_BT[..., None], goal + held, goal), yaw)

    def trace(self, inputs: HeadInputs, decoded: Decoded) -> StepTrace:
        """Explain what was decoded in one step."""
        candidates, (_, pick) = self.candidates(inputs), decoded[0]
        weights = {
            "pick": self.pick.prompt_weights(inputs)[:, 0],
            "place": self.place.prompt_weights(inputs, pick)[:, 0],
        }
        return StepTrace(
            [logits[:, 0] for logits, _ in decoded],
            normalize_weights(weights, inputs.prompt.mask_BL),
            (candidates.positions_BTC2[:, 0], candidates.masks_BTC[:, 0], candidates.kinds_C),
        )

    def candidates(self, inputs: HeadInputs) -> PlaceCandidates:
        """Return all place candidates."""
        return PlaceCandidates(inputs, self.grid(inputs.first_step))

    def relate(
        self,
        inputs: HeadInputs,
        candidates: PlaceCandidates,
        pick_BT: torch.Tensor,
        place_BT: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Offset from the candidate in metres, (B, T, 2), and logits of yaw bins, (B, T, bins)."""
        grasp, start = at(inputs.grasps_BTN2, pick_BT), at(inputs.positions_BTN2, pick_BT)
        goal = at(candidates.positions_BTC2, place_BT)
        metric = torch.cat([grasp - start, start - 0.5, goal - 0.5, goal - start], dim=-1) / OFFSET_UNIT_M
        token_BTD = candidates.tokens_at(place_BT)
        by_kind_BTED = torch.stack([layer(token_BTD) for layer in self.values], dim=2)
        value_BTD = at(by_kind_BTED, candidates.kinds_C[place_BT])
        tokens = [inputs.query_BTD, at(inputs.objects_BTND, pick_BT), value_BTD]
        metric = metric.to(inputs.query_BTD.dtype)
        hidden = torch.relu(self.relation(torch.cat([*tokens, metric], dim=-1)))
        yaw_logits = self.yaw(hidden)
        if self.rotation_copy is not None:
            yaw_logits = yaw_logits + self.rotation_copy(inputs, pick_BT, hidden)
        return self.offset(hidden) * OFFSET_UNIT_M, yaw_logits


class PickPointer(ObjectPointer):
    """A pointer whose keys know geometry: relative to the last pick and place, and to other objects.

    "… then put the object that was previously at its {direction} into the same {container}." And an object
    where a scene of the prompt shows another one has to be cleared away.

    Where the prompt selects attributes, similarity in them takes the place of that of appearance, which then
    has a learned weight: nothing is more like {base} than itself, but that is not to be put "into it". Beside
    exclusive attributes only the appearance of the very same object counts.
    """

    def __init__(
        self, config: CandidateHeadConfig, width: int, attributes: AttributeConfig | None = None
    ) -> None:
        super().__init__(width, config.num_prompt_queries)
        self._is_exclusive = attributes is not None and attributes.exclusive
        weight = torch.tensor(-1.0 if self._is_exclusive else 0.0)
        if attributes is not None:
            self.appearance_weight = nn.Parameter(weight)
        self.grounding = TextGrounding(width)
        self.geometry = mlp((10, config.hidden_width, width))

    def similarity(self, inputs: HeadInputs, scale_BTH: torch.Tensor) -> torch.Tensor:
        """Similarity to the attended prompt objects, and to what words describe, (B, T, N)."""
        appearance_BTA = self.grounding(inputs.prompt, inputs.query_BTD)
        described_BTN = (inputs.appearance_BTNA @ appearance_BTA[..., None]).squeeze(-1)
        similarity_BTN = (
            super().similarity(inputs, scale_BTH) + scale_BTH.sum(dim=-1, keepdim=True) * described_BTN
        )
        selected_BP, attributes_BLX = inputs.prompt.selected_BP, inputs.prompt.attributes_BLX
        if inputs.attributes_BTNX is None:
            return similarity_BTN
        assert selected_BP is not None and attributes_BLX is not None
        attended_BTHX = torch.softmax(self._attention_scores(inputs), dim=-1) @ attributes_BLX[:, None]
        attended_BTX = (scale_BTH[..., None] * attended_BTHX).sum(dim=2)
        attribute_similarity_BTN = (inputs.attributes_BTNX @ attended_BTX[..., None]).squeeze(-1)
        appearance_BTN = similarity_BTN
        if self._is_exclusive:
            scale_BT1 = scale_BTH.sum(dim=-1, keepdim=True)
            appearance_BTN = torch.relu(similarity_BTN - _SAME_APPEARANCE * scale_BT1) / (
                1 - _SAME_APPEARANCE
            )
        attribute_similarity_BTN = attribute_similarity_BTN + self.appearance_weight * appearance_BTN
        return torch.where(selected_BP.any(dim=1)[:, None, None], attribute_similarity_BTN, similarity_BTN)

    def prompt_weights(self, inputs: HeadInputs) -> torch.Tensor:
        """Return how much of the appearance that is looked for comes from each prompt position, (B, T, L)."""
        words_BTL = self.grounding.attention(inputs.prompt, inputs.query_BTD)
        words_BTL = words_BTL * inputs.prompt.text_appearance_BLA.norm(dim=-1)[:, None]
        return super().prompt_weights(inputs) + self._scale(inputs).sum(dim=-1, keepdim=True) * words_BTL

    def keys(self, inputs: HeadInputs) -> torch.Tensor:
        """Return the keys of the objects, geometry included, (B, T, N, D)."""
        keys_BTND, positions_BTN2 = super().keys(inputs), inputs.positions_BTN2
        # G: vector and distance to the last pick and to the last place, and that there was one; then how near
        # an object of the prompt's scenes is, another one in view, and one in or on this one.
        has_previous_BT11 = (inputs.previous_BTC != 0).any(dim=-1)[..., None, None]
        relative = []
        for start in (0, 6):
            vector_BTN2 = positions_BTN2 - inputs.previous_BTC[..., None, start : start + 2]
            vector_BTN2 = (vector_BTN2 / OFFSET_UNIT_M).clamp(-_MAX_DISTANCE, _MAX_DISTANCE)
            relative += [vector_BTN2, vector_BTN2.norm(dim=-1, keepdim=True)]
        relative_BTNG = torch.cat([*relative, torch.ones_like(relative[1])], dim=-1) * has_previous_BT11
        prompt, num_objects = inputs.prompt.objects, positions_BTN2.shape[2]
        is_other_NN = ~torch.eye(num_objects, dtype=torch.bool, device=positions_BTN2.device)
        others_BTNN = inputs.masks_BTN[:, :, None] & is_other_NN
        shown_BTNK = distances(positions_BTN2, prompt.positions_BK2[:, None])
        distance_BTNN = distances(positions_BTN2, positions_BTN2)
        near = [
            proximity(shown_BTNK, prompt.masks_BK[:, None, None]),
            proximity(distance_BTNN, others_BTNN),
            proximity(distance_BTNN, others_BTNN, _ON_TOP_M),
        ]
        geometry_BTNG = torch.cat([relative_BTNG, *near], dim=-1)
        return keys_BTND + self.geometry(geometry_BTNG.to(keys_BTND.dtype))


class RotationCopy(nn.Module):
    """Logits of the rotations that objects make between images of the prompt, and from the view to it.

    Args:
        width: Width of tokens.
        hidden_width: Width of what is known of pick and place.
    """

    def __init__(self, width: int, hidden_width: int) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.weight = nn.Linear(width, 1)
        self.to_prompt_weight = nn.Linear(hidden_width, 1)

    def forward(self, inputs: HeadInputs, pick_BT: torch.Tensor, hidden_BTH: torch.Tensor) -> torch.Tensor:
        """Return logits of the bins, (B, T, R)."""
        query_BTD, objects = inputs.query_BTD, inputs.prompt.objects
        scores_BTK = self.query(query_BTD) @ self.key(objects.tokens_BKD).mT * query_BTD.shape[-1] ** -0.5
        has_rotation_BK = objects.masks_BK & (objects.rotations_BKR > 0).any(dim=-1)
        weights_BTK = torch.softmax(mask_scores(scores_BTK, has_rotation_BK[:, None]), dim=-1)
        weights_BTK = weights_BTK * has_rotation_BK[:, None]
        between_BTR = F.softplus(self.weight(query_BTD)) * (weights_BTK @ objects.rotations_BKR)
        to_prompt_BTR = F.softplus(self.to_prompt_weight(hidden_BTH)) * at(inputs.rotations_BTNR, pick_BT)
        return _ROTATION_SCALE * (between_BTR + to_prompt_BTR)


class PlacePointer(nn.Module):
    """Scores the place candidates for an object that was picked.

    A logit sums up: query · key; similarity to the picked object, and to what the prompt asks for; the kind
    of candidate; and geometry relative to the picked object. What the prompt asks for is a prompt object
    that the query attends to, or words: "… into the blue object."
    """

    def __init__(self, config: CandidateHeadConfig, width: int) -> None:
        super().__init__()
        self.context = nn.Linear(2 * width, width)
        self.step_embedding = nn.Embedding(config.num_index_embeddings, width)
        self.image_embedding = nn.Embedding(config.num_index_embeddings, width)
        self.query = nn.Linear(width, width)
        self.keys = nn.ModuleList(nn.Linear(width, width) for _ in PLACE_KINDS)
        self.prompt_query = nn.Linear(width, width)
        self.prompt_key = nn.Linear(width, width)
        self.grounding = TextGrounding(width)
        # For each kind of candidate: weights of both similarities, and a bias.
        self.picked_scale, self.prompt_scale, self.kind_bias = (
            nn.Linear(width, len(PLACE_KINDS)) for _ in range(3)
        )
        self.geometry = nn.Linear(width, NUM_GEOMETRY)
        self.same = nn.Linear(width, 1)  # logit of the place of the picked object itself
        for layer, bias in (  # in the order of `PLACE_KINDS`
            (self.picked_scale, (0.0, 5.0, 5.0, 0.0)),
            (self.prompt_scale, (10.0, 0.0, 0.0, 0.0)),
        ):
            nn.init.zeros_(layer.weight)
            with torch.no_grad():
                layer.bias.copy_(torch.tensor(bias))
        for table in (self.step_embedding, self.image_embedding):
            nn.init.normal_(table.weight, std=0.1)

    def forward(self, inputs: HeadInputs, candidates: PlaceCandidates, pick_BT: torch.Tensor) -> torch.Tensor:
        """Return logits, (B, T, C); candidates that do not exist get the most negative number."""
        # Candidates are (C): those in view (N), which differ from step to step, then those kept for all steps
        # (K). Only the products are built for both at once, (B, T, C); kept keys have no axis of steps.
        last = self.step_embedding.num_embeddings - 1
        context_BTD = self._context(inputs, pick_BT)
        query_BTD = self.query(context_BTD) * inputs.query_BTD.shape[-1] ** -0.5
        kept_BKD = candidates.keys(self.keys) + self.image_embedding(
            candidates.image_index_BK.clamp(max=last)
        )
        logits_BTC = products(query_BTD, self.keys[0](inputs.objects_BTND), kept_BKD)
        kept_BKA, kinds_C = candidates.appearance_BKA, candidates.kinds_C
        for scale, appearance_BTA in (
            (self.picked_scale, at(inputs.appearance_BTNA, pick_BT)),
            (self.prompt_scale, self._prompt_appearance(inputs, context_BTD)),
        ):
            similarity_BTC = products(appearance_BTA, inputs.appearance_BTNA, kept_BKA)
            scale_BTC = F.softplus(scale(context_BTD)).index_select(-1, kinds_C)
            logits_BTC = logits_BTC + scale_BTC * similarity_BTC
        logits_BTC = logits_BTC + self.kind_bias(context_BTD).index_select(-1, kinds_C)
        geometry_BTCG = candidates.geometry(pick_BT).to(logits_BTC.dtype)
        logits_BTC = logits_BTC + torch.einsum("btg,btcg->btc", self.geometry(context_BTD), geometry_BTCG)
        # Objects in view come first, so the slot of the picked one is also the number of its candidate.
        picked_BTC = F.one_hot(pick_BT, logits_BTC.shape[-1]).to(logits_BTC.dtype)
        logits_BTC = logits_BTC + self.same(context_BTD) * picked_BTC
        return mask_scores(logits_BTC, candidates.masks_BTC)

    def appearance_scores(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
        """Return logits (B, T, N) of objects in view, by similarity to what the prompt asks for alone."""
        context_BTD = self._context(inputs, pick_BT)
        appearance_BTA = self._prompt_appearance(inputs, context_BTD)
        scores_BTN = (inputs.appearance_BTNA @ appearance_BTA[..., None]).squeeze(-1)
        scores_BTN = scores_BTN * F.softplus(self.prompt_scale(context_BTD))[..., :1].detach()
        return mask_scores(scores_BTN, inputs.masks_BTN)

    def prompt_weights(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
        """Return how much of the appearance that is looked for comes from each prompt position, (B, T, L)."""
        prompt, context_BTD = inputs.prompt, self._context(inputs, pick_BT)
        objects_BTL = (
            self._prompt_attention(prompt, context_BTD) * prompt.appearance_BLA.norm(dim=-1)[:, None]
        )
        words_BTL = self.grounding.attention(prompt, context_BTD)
        return objects_BTL + words_BTL * prompt.text_appearance_BLA.norm(dim=-1)[:, None]

    def _context(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
        """Combine the action query, the picked object and the index of the step, (B, T, D)."""
        steps_BT = inputs.steps_BT.clamp(max=self.step_embedding.num_embeddings - 1)
        picked_BTD = at(inputs.objects_BTND, pick_BT)
        context_BTD = self.context(torch.cat([inputs.query_BTD, picked_BTD], dim=-1))
        return torch.relu(context_BTD + self.step_embedding(steps_BT))

    def _prompt_appearance(self, inputs: HeadInputs, context_BTD: torch.Tensor) -> torch.Tensor:
        """Appearance of what the prompt asks for, (B, T, A): from words, and from the attended object."""
        prompt = inputs.prompt
        attended_BTA = self._prompt_attention(prompt, context_BTD) @ prompt.appearance_BLA
        return self.grounding(prompt, context_BTD) + attended_BTA

    def _prompt_attention(self, prompt: PointerPrompt, context_BTD: torch.Tensor) -> torch.Tensor:
        """Attention to the objects of the prompt, (B, T, L)."""
        query_BTD, key_BLD = self.prompt_query(context_BTD), self.prompt_key(prompt.masked_BLD)
        return torch.softmax(attention_scores(query_BTD, key_BLD, prompt.object_mask_BL), dim=-1)
