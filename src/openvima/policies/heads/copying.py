"""A head that copies places: it puts an object where another is, where one was, or where a picture shows one.

"Rearrange to this {scene} and then restore." asks for places at which nothing lies now. One of them is where
the scene shows the object, the other one where it lay at first; both were seen.

Shape suffixes as in `base.py`; C candidates for the place, E kinds of them, G features of how they lie, H
hidden width, R bins of turns.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import nn
from torch.nn import functional as F

from openvima.errors import ConfigError
from openvima.policies.heads.base import (
    ActionHead,
    ActionTargets,
    Choose,
    HeadInputs,
    ReadOn,
    Remembered,
    likeliest,
    masked_mean,
)
from openvima.policies.heads.candidates import (
    KINDS,
    NUM_GEOMETRY,
    FreePoints,
    beside,
    candidate_masks,
    geometry_of,
    kinds_of,
    positions_at,
    products,
    recollection_of,
    right_candidates,
    token_at,
    tokens_of_remembered,
)
from openvima.policies.heads.description import Description, attended
from openvima.policies.heads.pointing import (
    OFFSET_UNIT_M,
    Pointer,
    accuracy,
    at,
    carried_place,
    cross_entropy,
    offset_loss,
    pick_and_place,
    pointing_metrics,
    turn_of,
    turned,
    yaw_bin,
)
from openvima.policies.nn.mlp import mlp

_ON_TOP_M = 0.04  # an object so near to another one lies in or on it, more or less
_FAR = 10.0  # in units of offsets; beyond it, distances count as this
_SURE = 5.0  # score of a turn that is seen without doubt, before the network learns how much it counts


@dataclass(frozen=True, slots=True)
class CopyingConfig:
    """Sizes of the copying head and weights of its losses.

    Args:
        hidden_width: Width of the hidden layers that give offset and yaw.
        num_yaw_bins: Classes of the turn between pick and place, over a full circle; bin 0 means no turn.
        offset_weight: Weight of the offset's loss against the pointers'.
        yaw_weight: Weight of the yaw's loss.
        look_weight: Weight of the losses of picking, and of placing at an object in view, by looks alone.
            They teach which object of the prompt is meant, and what words describe; known objects can be
            found without, which is no help with novel ones.
        shown_weight: Weight of the loss of asking for the prompt object that looks most like the picked one,
            where one does. Else what else the prompt shows may serve as well, and not with other prompts.
        num_asked: Objects of the prompt that the pick is compared with at once.
        num_numbers: Images of a prompt, and steps, that are told apart by their number; later ones count as
            the last of these.
    """

    hidden_width: int = 128
    num_yaw_bins: int = 72
    offset_weight: float = 2.0
    yaw_weight: float = 0.5
    look_weight: float = 0.5
    shown_weight: float = 0.5
    num_asked: int = 2
    num_numbers: int = 16

    def __post_init__(self) -> None:
        if self.num_yaw_bins < 2 or min(self.hidden_width, self.num_asked, self.num_numbers) < 1:
            raise ConfigError(
                f"copying head: num_yaw_bins is {self.num_yaw_bins}, hidden_width {self.hidden_width}, "
                f"num_asked {self.num_asked} and num_numbers {self.num_numbers}; they must be at least 2, 1, "
                "1 and 1."
            )


class CopyingHead(ActionHead):
    """Points at the object to pick, then at a place to copy; offset and turn say what differs there.

    Candidates for the place, with two objects on the table and one in the only scene of the prompt:

        [1 in view, 2 in view, 1 at first, 2 at first, 1 in the scene, free point 1, …, free point 32]

    What is only to be cleared out of the way goes to a free point: a demonstration chooses one of many places
    that would do, and their mean would not.

    The centre of the picked object goes to the candidate's, moved by the offset. Where it is held, and how it
    is turned on the way, then says where the tool goes. So a wrong turn leaves the object in its place.

    Turns are copied as well, where the network estimates those that the prompt's images show in as many bins
    as the head has.
    """

    def __init__(self, config: CopyingConfig, width: int, turn_bins: int = 0) -> None:
        super().__init__()
        self.config = config
        self.shown_turn = ShownTurn(width) if turn_bins == config.num_yaw_bins else None
        self.pick = PickPointer(config, width)
        self.place = PlacePointer(config, width)
        self.free = FreePoints(width)
        self.values = nn.ModuleList(nn.Linear(width, width) for _ in KINDS)
        self.relation = mlp((3 * width + 8, config.hidden_width, config.hidden_width))
        self.offset = nn.Linear(config.hidden_width, 2)
        self.yaw = nn.Linear(config.hidden_width, config.num_yaw_bins)
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.offset.bias)

    def loss(
        self, inputs: HeadInputs, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Cross-entropy of both pointers, also by looks alone, and of the yaw, and Huber loss of the offset.

        Every candidate at the demonstrated place is right: the loss is that of their chances together. Where
        there is none, the object that the demonstration names is, and the offset has to lead from there to
        the place. If none is named, the nearest free point is right; metrics leave out such a step.
        """
        inputs, config = self.with_free_points(inputs), self.config
        has_pick, pick = targets.steps_BT & (targets.pick_BT >= 0), targets.pick_BT.clamp(min=0)
        pick_scores, place_scores = self.pick(inputs), self.place(inputs, pick)
        goal = self._goal(inputs, targets, pick)
        right_BTC, is_told_BT = right_candidates(inputs, targets, goal)
        right_BTC = right_BTC | ~has_pick[..., None]
        right_scores = place_scores.masked_fill(~right_BTC, torch.finfo(place_scores.dtype).min)
        copied = right_scores.argmax(-1)  # the right one that is chosen first
        offset, yaw_scores = self.relate(inputs, pick, copied)
        true_offset = goal - positions_at(inputs, copied)
        yaw = yaw_bin(turn_of(targets.actions_BTC), self.config.num_yaw_bins)
        surprise = place_scores.logsumexp(-1) - right_scores.logsumexp(-1)
        by_looks = self.pick.by_looks(inputs)
        at_shown, is_shown_BT = self.pick.surprise_at_shown(inputs, pick)
        has_other = has_pick & (targets.place_BT >= 0) & (targets.place_BT != pick)
        beside, place_by_looks = targets.place_BT.clamp(min=0), self.place.by_looks(inputs, pick)
        losses = {
            "pick": masked_mean(cross_entropy(pick_scores, pick), has_pick),
            "look": masked_mean(cross_entropy(by_looks, pick), has_pick) * config.look_weight,
            "shown": masked_mean(at_shown, has_pick & is_shown_BT) * config.shown_weight,
            "place_look": masked_mean(cross_entropy(place_by_looks, beside), has_other) * config.look_weight,
            "place": masked_mean(surprise, has_pick),
            "offset": masked_mean(offset_loss(offset, true_offset), has_pick) * config.offset_weight,
            "yaw": masked_mean(cross_entropy(yaw_scores, yaw), has_pick) * config.yaw_weight,
        }
        metrics = pointing_metrics(
            (pick_scores, place_scores, yaw_scores),
            (pick, copied, yaw),
            offset - true_offset,
            has_pick,
            has_pick & is_told_BT,
        )
        metrics["look_accuracy"] = accuracy(by_looks, pick, has_pick)
        return torch.stack(list(losses.values())).sum(), metrics

    def decide(
        self, inputs: HeadInputs, choose: Choose = likeliest, read_on: ReadOn | None = None
    ) -> torch.Tensor:
        """Point at an object and at a place, then bring the centre of the one to the other."""
        inputs = self.with_free_points(inputs)
        pick = choose(self.pick(inputs))
        place = choose(self.place(inputs, pick))
        offset, yaw_scores = self.relate(inputs, pick, place)
        offset = offset.to(inputs.positions_BTN2.dtype)  # half precision is too coarse for metres and radians
        turn = choose(yaw_scores).to(offset.dtype) * (2 * math.pi / self.config.num_yaw_bins)
        grasp, goal = at(inputs.grasps_BTN2, pick), positions_at(inputs, place) + offset
        held = turned(grasp - at(inputs.positions_BTN2, pick), turn)
        return pick_and_place(grasp, torch.where(inputs.lifts_BT[..., None], goal + held, goal), turn)

    def relate(
        self, inputs: HeadInputs, pick_BT: torch.Tensor, place_BT: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Offset from the candidate in metres, (B, T, 2), and scores of yaw bins, (B, T, bins)."""
        grasp, start = at(inputs.grasps_BTN2, pick_BT), at(inputs.positions_BTN2, pick_BT)
        goal = positions_at(inputs, place_BT)
        metric = torch.cat([grasp - start, start - 0.5, goal - 0.5, goal - start], dim=-1) / OFFSET_UNIT_M
        kept = recollection_of(inputs)
        token_BTD = token_at(inputs, place_BT)
        by_kind_BTED = torch.stack([layer(token_BTD) for layer in self.values], dim=2)
        value = at(by_kind_BTED, kinds_of(inputs)[place_BT])
        tokens = [inputs.query_BTD, at(inputs.objects_BTND, pick_BT), value]
        metric = metric.to(inputs.query_BTD.dtype)
        hidden_BTH = torch.relu(self.relation(torch.cat([*tokens, metric], dim=-1)))
        yaw_scores = self.yaw(hidden_BTH)
        if self.shown_turn is not None:
            yaw_scores = yaw_scores + self.shown_turn(inputs.query_BTD, kept.scenes)
        return self.offset(hidden_BTH) * OFFSET_UNIT_M, yaw_scores

    def _goal(self, inputs: HeadInputs, targets: ActionTargets, pick_BT: torch.Tensor) -> torch.Tensor:
        """Where the centre of the picked object goes, or the tool that pushes it, (B, T, 2), metres."""
        actions = targets.actions_BTC
        centre = carried_place(actions, at(inputs.positions_BTN2, pick_BT))
        return torch.where(inputs.lifts_BT[..., None], centre, actions[..., 6:8])

    def with_free_points(self, inputs: HeadInputs) -> HeadInputs:
        """Add the free points to what may be copied."""
        kept = recollection_of(inputs)
        return replace(inputs, recollection=replace(kept, free=self.free(kept.first)))


class PickPointer(Pointer):
    """A pointer that also knows how objects lie: to where the last one was picked, and put, and to others.

    "… then put the object that was previously at its {direction} into the same {container}." And what lies
    where a scene of the prompt shows another object is to be cleared out of the way.
    """

    def __init__(self, config: CopyingConfig, width: int) -> None:
        super().__init__(width, config.num_asked)
        self.described = Description(width)
        self.lying = mlp((10, config.hidden_width, width))

    def _looks(self, inputs: HeadInputs, sharpness_BTH: torch.Tensor) -> torch.Tensor:
        """As objects of the prompt look that the query attends to, and as words say."""
        described_BTA = self.described(inputs, inputs.query_BTD)
        alike_BTN = (inputs.appearance_BTNA @ described_BTA[..., None]).squeeze(-1)
        return super()._looks(inputs, sharpness_BTH) + sharpness_BTH.sum(dim=-1, keepdim=True) * alike_BTN

    def keys(self, inputs: HeadInputs) -> torch.Tensor:
        """Return what is known of the objects and of how they lie, (B, T, N, D)."""
        keys_BTND, previous_BTC = super().keys(inputs), inputs.previous_BTC
        assert previous_BTC is not None  # the network tells heads that copy
        has_previous_BT1 = (previous_BTC != 0).any(dim=-1)[..., None, None]
        apart = []
        for start in (0, 6):
            vector_BTN2 = inputs.positions_BTN2 - previous_BTC[..., None, start : start + 2]
            vector_BTN2 = (vector_BTN2 / OFFSET_UNIT_M).clamp(-_FAR, _FAR)
            apart += [vector_BTN2, vector_BTN2.norm(dim=-1, keepdim=True)]
        is_there_BTN1 = torch.ones_like(apart[1])
        since_BTNG = torch.cat([*apart, is_there_BTN1], dim=-1) * has_previous_BT1
        scenes, places_BTN2 = recollection_of(inputs).scenes, inputs.positions_BTN2
        is_other_NN = ~torch.eye(places_BTN2.shape[2], dtype=torch.bool, device=places_BTN2.device)
        others_BTNN = inputs.masks_BTN[:, :, None] & is_other_NN
        near = [
            beside(places_BTN2, scenes.positions_BK2[:, None], scenes.masks_BK[:, None, None]),
            beside(places_BTN2, places_BTN2, others_BTNN),
            beside(places_BTN2, places_BTN2, others_BTNN, _ON_TOP_M),
        ]
        lies_BTNG = torch.cat([since_BTNG, *near], dim=-1)
        return keys_BTND + self.lying(lies_BTNG.to(keys_BTND.dtype))


class ShownTurn(nn.Module):
    """Scores of the turns that objects make from one image of the prompt to another."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.weight = nn.Linear(width, 1)  # how much what is shown counts

    def forward(self, query_BTD: torch.Tensor, scenes: Remembered) -> torch.Tensor:
        """Return the scores of the bins, (B, T, R)."""
        assert scenes.turns_BKR is not None  # the network estimates them
        scores_BTK = self.query(query_BTD) @ self.key(scenes.tokens_BKD).mT * query_BTD.shape[-1] ** -0.5
        has_turn_BK = scenes.masks_BK & (scenes.turns_BKR > 0).any(dim=-1)
        scores_BTK = scores_BTK.masked_fill(~has_turn_BK[:, None], torch.finfo(scores_BTK.dtype).min)
        chances_BTK = torch.softmax(scores_BTK, dim=-1) * has_turn_BK[:, None]
        return F.softplus(self.weight(query_BTD)) * _SURE * (chances_BTK @ scenes.turns_BKR)


class PlacePointer(nn.Module):
    """Scores the candidates for the place of an object that was chosen.

    A score sums up: query · key; how much the candidate looks like the picked object, and like what is asked
    for; where it comes from; and how it lies to the picked object. What is asked for is a prompt object that
    the query attends to, or words: "… into the blue object."
    """

    def __init__(self, config: CopyingConfig, width: int) -> None:
        super().__init__()
        self.context = nn.Linear(2 * width, width)
        self.steps = nn.Embedding(config.num_numbers, width)
        self.images = nn.Embedding(config.num_numbers, width)
        self.query = nn.Linear(width, width)
        self.keys = nn.ModuleList(nn.Linear(width, width) for _ in KINDS)
        self.prompt_query = nn.Linear(width, width)
        self.prompt_key = nn.Linear(width, width)
        self.described = Description(width)
        # For each kind of candidate: how much either likeness counts, and how much the kind is wanted.
        self.alike, self.asked, self.kind = (nn.Linear(width, len(KINDS)) for _ in range(3))
        self.geometry = nn.Linear(width, NUM_GEOMETRY)
        self.same = nn.Linear(width, 1)  # how much the place wants to be that of the picked object itself
        for layer, bias in ((self.alike, (0.0, 5.0, 5.0, 0.0)), (self.asked, (10.0, 0.0, 0.0, 0.0))):
            nn.init.zeros_(layer.weight)
            with torch.no_grad():
                layer.bias.copy_(torch.tensor(bias))
        for table in (self.steps, self.images):
            nn.init.normal_(table.weight, std=0.1)

    def forward(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
        """Return scores, shape (B, T, C); candidates that do not exist score the most negative number."""
        kept, last = recollection_of(inputs), self.steps.num_embeddings - 1
        context_BTD = self._context(inputs, pick_BT)
        query_BTD = self.query(context_BTD) * inputs.query_BTD.shape[-1] ** -0.5
        numbers_BK = torch.cat([part.numbers_BK for part in kept.parts], dim=1)
        kept_BKD = tokens_of_remembered(self.keys, kept) + self.images(numbers_BK.clamp(max=last))
        keys_BTND = self.keys[0](inputs.objects_BTND)
        scores_BTC = products(query_BTD, keys_BTND, kept_BKD)
        kept_BKA = torch.cat([part.appearance_BKA for part in kept.parts], dim=1)
        picked_BTA = at(inputs.appearance_BTNA, pick_BT)
        alike_BTC = products(picked_BTA, inputs.appearance_BTNA, kept_BKA)
        asked_BTC = products(self._asked_look(inputs, context_BTD), inputs.appearance_BTNA, kept_BKA)
        kinds_C = kinds_of(inputs)
        scores_BTC = scores_BTC + F.softplus(self.alike(context_BTD))[..., kinds_C] * alike_BTC
        scores_BTC = scores_BTC + F.softplus(self.asked(context_BTD))[..., kinds_C] * asked_BTC
        scores_BTC = scores_BTC + self.kind(context_BTD)[..., kinds_C]
        lies_BTCG = geometry_of(inputs, pick_BT).to(scores_BTC.dtype)
        scores_BTC = scores_BTC + torch.einsum("btg,btcg->btc", self.geometry(context_BTD), lies_BTCG)
        picked_BTC = F.one_hot(pick_BT, scores_BTC.shape[-1]).to(scores_BTC.dtype)
        scores_BTC = scores_BTC + self.same(context_BTD) * picked_BTC
        return scores_BTC.masked_fill(~candidate_masks(inputs), torch.finfo(scores_BTC.dtype).min)

    def by_looks(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
        """Return scores (B, T, N) of objects in view, by likeness to what is asked for alone."""
        context_BTD = self._context(inputs, pick_BT)
        look_BTA = self._asked_look(inputs, context_BTD)
        scores_BTN = (inputs.appearance_BTNA @ look_BTA[..., None]).squeeze(-1)
        scores_BTN = scores_BTN * F.softplus(self.asked(context_BTD))[..., :1].detach()
        return scores_BTN.masked_fill(~inputs.masks_BTN, torch.finfo(scores_BTN.dtype).min)

    def _context(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
        """What decides on the place: what is asked for, for which object, and at which step, (B, T, D)."""
        steps_T = recollection_of(inputs).steps_T.clamp(max=self.steps.num_embeddings - 1)
        picked_BTD = at(inputs.objects_BTND, pick_BT)
        context_BTD = self.context(torch.cat([inputs.query_BTD, picked_BTD], dim=-1))
        return torch.relu(context_BTD + self.steps(steps_T))

    def _asked_look(self, inputs: HeadInputs, context_BTD: torch.Tensor) -> torch.Tensor:
        """How what is asked for looks, (B, T, A): as words say, and as the prompt object attended to."""
        look_BTA = self.described(inputs, context_BTD)
        if not inputs.prompt_BMD.shape[1]:
            return look_BTA
        query_BTD, key_BMD = self.prompt_query(context_BTD), self.prompt_key(inputs.prompt_BMD)
        return look_BTA + attended(query_BTD, key_BMD, inputs.prompt_masks_BM, inputs.prompt_appearance_BMA)
