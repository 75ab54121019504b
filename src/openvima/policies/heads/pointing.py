"""A head that points: at the object to pick, at the object to place it by, and a small offset from there.

Shape suffixes as in `base.py`; H hidden width.
"""

import math
from dataclasses import dataclass

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
    from_unit_range,
    likeliest,
    masked_mean,
    to_unit_range,
)
from openvima.policies.nn.mlp import mlp

OFFSET_UNIT_M = 0.1  # the network speaks of offsets in decimetres, so that they are of the order of 1
_ALIKE = 0.3  # cosine of embeddings from which on two pictures may show the same object
_NEARLY_ALIKE = 0.1  # a difference of cosines that says little
RIGHT_OFFSET_M = 0.02  # a place this near to the demonstrated one counts as right in the metrics


@dataclass(frozen=True, slots=True)
class PointingConfig:
    """Sizes of the pointing head and weights of its losses.

    Args:
        hidden_width: Width of the hidden layers that give offset and yaw.
        num_yaw_bins: Classes of the turn between pick and place, over a full circle; bin 0 means no turn.
        offset_weight: Weight of the offset's loss against the pointers'.
        yaw_weight: Weight of the yaw's loss.
    """

    hidden_width: int = 128
    num_yaw_bins: int = 72
    offset_weight: float = 2.0
    yaw_weight: float = 0.5

    def __post_init__(self) -> None:
        if self.num_yaw_bins < 2 or self.hidden_width < 1:
            raise ConfigError("pointing head: it needs at least 2 yaw bins and a hidden width of at least 1.")


class PointingHead(ActionHead):
    """Two pointers over the objects in view, then offset and yaw for what they point at.

    A pointer scores each object by query · key, plus the similarity of its appearance with that of the prompt
    object which the query attends to. "Put the A into the B": the pick's query attends to A in the prompt,
    and whatever in the scene looks like A gets the score, be that look known from training or not.
    """

    def __init__(self, config: PointingConfig, width: int) -> None:
        super().__init__()
        self.config = config
        self.pick = Pointer(width)
        self.place = Pointer(width)
        self.same = nn.Linear(width, 1)  # how much the place wants to be the picked object itself
        self.relation = mlp((3 * width + 6, config.hidden_width, config.hidden_width))
        self.offset = nn.Linear(config.hidden_width, 2)
        self.yaw = nn.Linear(config.hidden_width, config.num_yaw_bins)
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.offset.bias)

    def loss(
        self, inputs: HeadInputs, targets: ActionTargets
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Cross-entropy of both pointers and of the yaw, and Huber loss of the offset."""
        has_pick = targets.steps_BT & (targets.pick_BT >= 0)
        has_place = has_pick & (targets.place_BT >= 0)
        pick, place = targets.pick_BT.clamp(min=0), targets.place_BT.clamp(min=0)
        pick_scores = self.pick(inputs)
        place_scores = self.place_scores(inputs, pick)
        offset, yaw_scores = self.relate(inputs, pick, place)
        actions = targets.actions_BTC
        grasp = at(inputs.grasps_BTN2, pick)
        true_place = torch.where(inputs.lifts_BT[..., None], carried_place(actions, grasp), actions[..., 6:8])
        true_offset = true_place - at(inputs.positions_BTN2, place)
        yaw = yaw_bin(turn_of(actions), self.config.num_yaw_bins)
        losses = {
            "pick": masked_mean(cross_entropy(pick_scores, pick), has_pick),
            "place": masked_mean(cross_entropy(place_scores, place), has_place),
            "offset": masked_mean(offset_loss(offset, true_offset), has_place) * self.config.offset_weight,
            "yaw": masked_mean(cross_entropy(yaw_scores, yaw), has_place) * self.config.yaw_weight,
        }
        metrics = pointing_metrics(
            (pick_scores, place_scores, yaw_scores),
            (pick, place, yaw),
            offset - true_offset,
            has_pick,
            has_place,
        )
        return torch.stack(list(losses.values())).sum(), metrics

    def decide(
        self, inputs: HeadInputs, choose: Choose = likeliest, read_on: ReadOn | None = None
    ) -> torch.Tensor:
        """Point, then place: at the grasp point of the picked object, and by the offset from the other."""
        pick = choose(self.pick(inputs))
        place = choose(self.place_scores(inputs, pick))
        offset, yaw_scores = self.relate(inputs, pick, place)
        offset = offset.to(inputs.positions_BTN2.dtype)  # half precision is too coarse for metres and radians
        turn = choose(yaw_scores).to(offset.dtype) * (2 * math.pi / self.config.num_yaw_bins)
        return pick_and_place(at(inputs.grasps_BTN2, pick), at(inputs.positions_BTN2, place) + offset, turn)

    def place_scores(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
        """Scores (B, T, N) of the place, given the slot of the picked object."""
        picked_BTN = F.one_hot(pick_BT, inputs.masks_BTN.shape[-1]).to(inputs.query_BTD.dtype)
        return self.place(inputs) + self.same(inputs.query_BTD) * picked_BTN

    def relate(
        self, inputs: HeadInputs, pick_BT: torch.Tensor, place_BT: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Offset from the place object in metres, (B, T, 2), and scores of yaw bins, (B, T, bins)."""
        grasp, start = at(inputs.grasps_BTN2, pick_BT), at(inputs.positions_BTN2, pick_BT)
        goal = at(inputs.positions_BTN2, place_BT)
        tokens = [inputs.query_BTD, at(inputs.objects_BTND, pick_BT), at(inputs.objects_BTND, place_BT)]
        metric = torch.cat([grasp - start, start - 0.5, goal - 0.5], dim=-1) / OFFSET_UNIT_M
        metric = metric.to(inputs.query_BTD.dtype)
        hidden_BTH = torch.relu(self.relation(torch.cat([*tokens, metric], dim=-1)))
        return self.offset(hidden_BTH) * OFFSET_UNIT_M, self.yaw(hidden_BTH)


class Pointer(nn.Module):
    """Scores the objects in view for one role.

    Args:
        width: Width of tokens.
        num_asked: Objects of the prompt that are looked for at once: what is meant, and, say, what shows how
            it is to be.
    """

    def __init__(self, width: int, num_asked: int = 1) -> None:
        super().__init__()
        self.num_asked = num_asked
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.prompt_query = nn.Linear(width, num_asked * width)
        self.prompt_key = nn.Linear(width, width)
        self.sharpness = nn.Linear(width, num_asked)  # how much each look counts in this situation
        nn.init.zeros_(self.sharpness.weight)
        nn.init.constant_(self.sharpness.bias, 10.0 / num_asked)

    def forward(self, inputs: HeadInputs) -> torch.Tensor:
        """Return scores, shape (B, T, N); objects that do not exist score the most negative number."""
        scale = inputs.query_BTD.shape[-1] ** -0.5
        query_BTD = self.query(inputs.query_BTD)
        scores_BTN = (self.keys(inputs) @ query_BTD[..., None]).squeeze(-1) * scale
        return self._existing(scores_BTN + self._looks(inputs, self._sharpness(inputs)), inputs)

    def by_looks(self, inputs: HeadInputs) -> torch.Tensor:
        """Return the scores by looks alone, as `forward`; their gradient goes to what is attended to."""
        return self._existing(self._looks(inputs, self._sharpness(inputs).detach()), inputs)

    def surprise_at_shown(
        self, inputs: HeadInputs, pick_BT: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """How surprised the first of the H is that the prompt object most like the picked one is meant.

        Returns:
            Negative log-likelihoods, and whether the prompt shows an object that is like it at all, both
            (B, T). Prompt objects that look nearly as much like it count as nearly as right.
        """
        if not inputs.prompt_BMD.shape[1]:
            return torch.zeros_like(inputs.query_BTD[..., 0]), torch.zeros_like(pick_BT, dtype=torch.bool)
        picked_BTA = at(inputs.appearance_BTNA, pick_BT)
        alike_BTM = (picked_BTA @ inputs.prompt_appearance_BMA.mT).detach()
        alike_BTM = alike_BTM.masked_fill(~inputs.prompt_masks_BM[:, None], -1.0)
        most_BT1 = alike_BTM.amax(dim=-1, keepdim=True)
        chances_BTM = torch.log_softmax(self._asked(inputs)[:, :, 0], dim=-1)
        right_BTM = chances_BTM + (alike_BTM - most_BT1) / _NEARLY_ALIKE
        return -right_BTM.logsumexp(dim=-1), most_BT1.squeeze(-1) > _ALIKE

    def _sharpness(self, inputs: HeadInputs) -> torch.Tensor:
        return F.softplus(self.sharpness(inputs.query_BTD))

    def _looks(self, inputs: HeadInputs, sharpness_BTH: torch.Tensor) -> torch.Tensor:
        """How much objects look like the H prompt objects that the query attends to, (B, T, N)."""
        if not inputs.prompt_BMD.shape[1]:
            return torch.zeros_like(inputs.appearance_BTNA[..., 0])
        look_BTHA = torch.softmax(self._asked(inputs), dim=-1) @ inputs.prompt_appearance_BMA[:, None]
        look_BTA = (sharpness_BTH[..., None] * look_BTHA).sum(dim=2)
        return (inputs.appearance_BTNA @ look_BTA[..., None]).squeeze(-1)

    def _asked(self, inputs: HeadInputs) -> torch.Tensor:
        """How much the query asks for each object of the prompt, scores (B, T, H, M)."""
        query_BTHD = self.prompt_query(inputs.query_BTD).unflatten(-1, (self.num_asked, -1))
        asked_BTHM = query_BTHD @ self.prompt_key(inputs.prompt_BMD)[:, None].mT
        asked_BTHM = asked_BTHM * inputs.query_BTD.shape[-1] ** -0.5
        hidden = torch.finfo(asked_BTHM.dtype).min
        return asked_BTHM.masked_fill(~inputs.prompt_masks_BM[:, None, None], hidden)

    def _existing(self, scores_BTN: torch.Tensor, inputs: HeadInputs) -> torch.Tensor:
        return scores_BTN.masked_fill(~inputs.masks_BTN, torch.finfo(scores_BTN.dtype).min)

    def keys(self, inputs: HeadInputs) -> torch.Tensor:
        """Return what the query is compared with, (B, T, N, D)."""
        return self.key(inputs.objects_BTND)


def offset_loss(offset_BT2: torch.Tensor, true_offset_BT2: torch.Tensor) -> torch.Tensor:
    """Huber loss of offsets in metres, (B, T)."""
    scaled = (offset_BT2 / OFFSET_UNIT_M, true_offset_BT2 / OFFSET_UNIT_M)
    return F.smooth_l1_loss(*scaled, reduction="none", beta=0.1).sum(-1)


@torch.no_grad()
def pointing_metrics(
    scores: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    right: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    error_BT2: torch.Tensor,
    has_pick_BT: torch.Tensor,
    is_told_BT: torch.Tensor,
) -> dict[str, torch.Tensor]:
    """Shares of right choices, and the mean error of the offset.

    Args:
        scores: Of pick, place and yaw, (B, T, classes) each.
        right: The right classes, (B, T) each.
        error_BT2: What the offset lacks, metres.
        has_pick_BT: At which steps the object to pick is known.
        is_told_BT: At which of these the place is, too.
    """
    (pick_scores, place_scores, yaw_scores), (pick, place, yaw) = scores, right
    error_BT = error_BT2.norm(dim=-1)
    right_BT = (pick_scores.argmax(-1) == pick) & (place_scores.argmax(-1) == place)
    right_BT &= error_BT < RIGHT_OFFSET_M
    return {
        "accuracy": masked_mean(right_BT.to(error_BT2.dtype), is_told_BT),
        "pick_accuracy": accuracy(pick_scores, pick, has_pick_BT),
        "place_accuracy": accuracy(place_scores, place, is_told_BT),
        "yaw_accuracy": accuracy(yaw_scores, yaw, is_told_BT),
        "offset_error_m": masked_mean(error_BT, is_told_BT),
    }


def pick_and_place(grasp_BT2: torch.Tensor, put_BT2: torch.Tensor, turn_BT: torch.Tensor) -> torch.Tensor:
    """Actions (B, T, 12), within bounds, that pick at one place and put at another, turned by radians."""
    zero, one = torch.zeros_like(turn_BT), torch.ones_like(turn_BT)
    pose0 = [grasp_BT2, torch.stack([zero, zero, zero, one], dim=-1)]
    half = turn_BT / 2
    pose1 = [put_BT2, torch.stack([zero, zero, torch.sin(half), torch.cos(half)], dim=-1)]
    return from_unit_range(to_unit_range(torch.cat(pose0 + pose1, dim=-1)))


def at(values_BTNX: torch.Tensor, slot_BT: torch.Tensor) -> torch.Tensor:
    """Take the row of one slot at every step: (B, T, N, X) and (B, T) give (B, T, X)."""
    index = slot_BT[..., None, None].expand(*slot_BT.shape, 1, values_BTNX.shape[-1])
    return values_BTNX.gather(2, index).squeeze(2)


def turn_of(actions_BTC: torch.Tensor) -> torch.Tensor:
    """Yaw of pose1 against pose0 in radians, shape (B, T)."""
    yaws = []
    for start in (2, 8):
        x, y, z, w = actions_BTC[..., start : start + 4].unbind(-1)
        yaws.append(torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    return yaws[1] - yaws[0]


def carried_place(actions_BTC: torch.Tensor, grasp_BT2: torch.Tensor) -> torch.Tensor:
    """Where a grasp point goes if the object moves as it did when it was grasped elsewhere.

    The demonstrator may hold an object by another of its points than the policy would. The object moves
    rigidly, so that place' = place + turn · (grasp' − grasp).

    Args:
        actions_BTC: The demonstrated actions.
        grasp_BT2: The policy's grasp points, metres.

    Returns:
        Places for them, shape (B, T, 2), metres.
    """
    held_BT2 = grasp_BT2 - actions_BTC[..., 0:2]
    return actions_BTC[..., 6:8] + turned(held_BT2, turn_of(actions_BTC))


def turned(vectors_BT2: torch.Tensor, turn_BT: torch.Tensor) -> torch.Tensor:
    """Turn vectors on the table by angles in radians, counterclockwise seen from above."""
    x, y = vectors_BT2.unbind(-1)
    cosine, sine = torch.cos(turn_BT), torch.sin(turn_BT)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)


def yaw_bin(turn: torch.Tensor, num_bins: int) -> torch.Tensor:
    """Nearest of `num_bins` equal steps around the circle, int64."""
    return torch.round(turn / (2 * math.pi / num_bins)).to(torch.int64) % num_bins


def cross_entropy(scores_BTN: torch.Tensor, target_BT: torch.Tensor) -> torch.Tensor:
    """Negative log-likelihood of a class at every step, shape (B, T)."""
    loss = F.cross_entropy(scores_BTN.flatten(0, 1), target_BT.flatten(), reduction="none")
    return loss.view_as(target_BT)


def accuracy(scores_BTN: torch.Tensor, target_BT: torch.Tensor, mask_BT: torch.Tensor) -> torch.Tensor:
    """Share of the steps at which the class scores highest."""
    return masked_mean((scores_BTN.argmax(-1) == target_BT).to(scores_BTN.dtype), mask_BT)
