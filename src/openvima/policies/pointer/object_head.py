"""The head of `nano`: point at the object to pick, at the object to place it by, and predict an offset.

Shape suffixes as in `inputs.py`; H prompt queries.
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
    yaw_between,
)
from openvima.policies.nn.layers import mlp
from openvima.policies.nn.policy_network import Decoded, StepTrace, normalize_weights
from openvima.policies.pointer.config import ObjectHeadConfig
from openvima.policies.pointer.inputs import (
    OFFSET_UNIT_M,
    HeadInputs,
    bin_to_yaw,
    demonstrated_place,
    offset_loss,
    pick_and_place,
    pointing_metrics,
    yaw_to_bin,
)

_SAME_OBJECT = 0.3  # similarity of appearance from which on two images may show the same object
_SIMILARITY_SCALE = 0.1  # a difference of similarities that is hardly significant


class ObjectPointerHead(nn.Module):
    """Two pointers over the objects in view, then offset and yaw for what they point at."""

    def __init__(self, config: ObjectHeadConfig, width: int) -> None:
        super().__init__()
        self.config = config
        self.pick = ObjectPointer(width)
        self.place = ObjectPointer(width)
        self.same = nn.Linear(width, 1)  # logit of placing by the picked object itself
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
        pick_logits, place_logits = self.pick(inputs), self.place_logits(inputs, pick)
        offset, yaw_logits = self.relate(inputs, pick, place)
        true_place = demonstrated_place(inputs, targets, inputs.grasps_BTN2, pick)
        true_offset = true_place - at(inputs.positions_BTN2, place)
        yaw = yaw_to_bin(yaw_between(targets.actions_BTC), self.config.num_yaw_bins)
        losses = {
            "pick": masked_mean(nll(pick_logits, pick), has_pick),
            "place": masked_mean(nll(place_logits, place), has_place),
            "offset": masked_mean(offset_loss(offset, true_offset), has_place) * self.config.offset_weight,
            "yaw": masked_mean(nll(yaw_logits, yaw), has_place) * self.config.yaw_weight,
        }
        metrics = pointing_metrics(
            (pick_logits, place_logits, yaw_logits),
            (pick, place, yaw),
            offset - true_offset,
            has_pick,
            has_place,
        )
        return sum_losses(losses, metrics)

    def decode(self, inputs: HeadInputs, strategy: DecodingStrategy = greedy) -> torch.Tensor:
        """Pick at the grasp point of one object, place at the offset from another; (B, T, 12)."""
        pick = strategy(self.pick(inputs))
        place = strategy(self.place_logits(inputs, pick))
        offset, yaw_logits = self.relate(inputs, pick, place)
        offset = offset.to(inputs.positions_BTN2.dtype)  # half precision is too coarse for metres and radians
        yaw = bin_to_yaw(strategy(yaw_logits), self.config.num_yaw_bins, offset.dtype)
        return pick_and_place(at(inputs.grasps_BTN2, pick), at(inputs.positions_BTN2, place) + offset, yaw)

    def trace(self, inputs: HeadInputs, decoded: Decoded) -> StepTrace:
        """Explain what was decoded in one step."""
        pointers = {"pick": self.pick, "place": self.place}
        weights = {name: pointer.prompt_weights(inputs)[:, 0] for name, pointer in pointers.items()}
        in_view_N = torch.zeros(inputs.masks_BTN.shape[-1], dtype=torch.int64)
        return StepTrace(
            [logits[:, 0] for logits, _ in decoded],
            normalize_weights(weights, inputs.prompt.mask_BL),
            (inputs.positions_BTN2[:, 0], inputs.masks_BTN[:, 0], in_view_N),
        )

    def place_logits(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
        """Logits (B, T, N) of the place, given the slot of the picked object."""
        picked_BTN = F.one_hot(pick_BT, inputs.masks_BTN.shape[-1]).to(inputs.query_BTD.dtype)
        return self.place(inputs) + self.same(inputs.query_BTD) * picked_BTN

    def relate(
        self, inputs: HeadInputs, pick_BT: torch.Tensor, place_BT: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Offset from the place object in metres, (B, T, 2), and logits of yaw bins, (B, T, bins)."""
        grasp, start = at(inputs.grasps_BTN2, pick_BT), at(inputs.positions_BTN2, pick_BT)
        goal = at(inputs.positions_BTN2, place_BT)
        tokens = [inputs.query_BTD, at(inputs.objects_BTND, pick_BT), at(inputs.objects_BTND, place_BT)]
        metric = torch.cat([grasp - start, start - 0.5, goal - 0.5], dim=-1) / OFFSET_UNIT_M
        metric = metric.to(inputs.query_BTD.dtype)
        hidden = torch.relu(self.relation(torch.cat([*tokens, metric], dim=-1)))
        return self.offset(hidden) * OFFSET_UNIT_M, self.yaw(hidden)


class ObjectPointer(nn.Module):
    """Scores the objects in view for one role.

    A score is query · key, plus the similarity to the prompt objects that the query attends to. "Put the A
    into the B": the pick's query attends to A in the prompt, and objects that look like A score high,
    whether their appearance is known from training or not.

    Args:
        width: Width of tokens.
        num_prompt_queries: Prompt objects that are attended to at once.
    """

    def __init__(self, width: int, num_prompt_queries: int = 1) -> None:
        super().__init__()
        self.num_prompt_queries = num_prompt_queries
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(width, width)
        self.prompt_query = nn.Linear(width, num_prompt_queries * width)
        self.prompt_key = nn.Linear(width, width)
        self.logit_scale = nn.Linear(width, num_prompt_queries)  # weight of each similarity, by situation
        nn.init.zeros_(self.logit_scale.weight)
        nn.init.constant_(self.logit_scale.bias, 10.0 / num_prompt_queries)

    def forward(self, inputs: HeadInputs) -> torch.Tensor:
        """Return logits, shape (B, T, N); objects that do not exist get the most negative number."""
        query_BTD = self.query(inputs.query_BTD)
        logits_BTN = (self.keys(inputs) @ query_BTD[..., None]).squeeze(-1) * query_BTD.shape[-1] ** -0.5
        logits_BTN = logits_BTN + self.similarity(inputs, self._scale(inputs))
        return mask_scores(logits_BTN, inputs.masks_BTN)

    def appearance_scores(self, inputs: HeadInputs) -> torch.Tensor:
        """Return logits by appearance alone; their gradient goes to the attention to the prompt."""
        return mask_scores(self.similarity(inputs, self._scale(inputs).detach()), inputs.masks_BTN)

    def grounding_nll(self, inputs: HeadInputs, pick_BT: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Negative log-likelihood of attending to the prompt object most similar to the picked one.

        Only the first prompt query is trained so. Prompt objects that are nearly as similar count as nearly
        as right.

        Returns:
            The loss, and whether the prompt shows a similar object at all, both (B, T).
        """
        prompt, picked_BTA = inputs.prompt, at(inputs.appearance_BTNA, pick_BT)
        similarity_BTL = (picked_BTA @ prompt.appearance_BLA.mT).detach()
        similarity_BTL = similarity_BTL.masked_fill(~prompt.object_mask_BL[:, None], -1.0)
        highest_BT1 = similarity_BTL.amax(dim=-1, keepdim=True)
        log_probs_BTL = torch.log_softmax(self._attention_scores(inputs)[:, :, 0], dim=-1)
        right_BTL = log_probs_BTL + (similarity_BTL - highest_BT1) / _SIMILARITY_SCALE
        return -right_BTL.logsumexp(dim=-1), highest_BT1.squeeze(-1) > _SAME_OBJECT

    def similarity(self, inputs: HeadInputs, scale_BTH: torch.Tensor) -> torch.Tensor:
        """Similarity of objects to the attended prompt objects, (B, T, N)."""
        appearance_BTHA = (
            torch.softmax(self._attention_scores(inputs), dim=-1) @ inputs.prompt.appearance_BLA[:, None]
        )
        appearance_BTA = (scale_BTH[..., None] * appearance_BTHA).sum(dim=2)
        return (inputs.appearance_BTNA @ appearance_BTA[..., None]).squeeze(-1)

    def prompt_weights(self, inputs: HeadInputs) -> torch.Tensor:
        """Return how much of the appearance that is looked for comes from each prompt position, (B, T, L)."""
        weights_BTHL = torch.softmax(self._attention_scores(inputs), dim=-1)
        weights_BTL = (self._scale(inputs)[..., None] * weights_BTHL).sum(dim=2)
        return weights_BTL * inputs.prompt.appearance_BLA.norm(dim=-1)[:, None]

    def keys(self, inputs: HeadInputs) -> torch.Tensor:
        """Return the keys of the objects, (B, T, N, D)."""
        return self.key(inputs.objects_BTND)

    def _scale(self, inputs: HeadInputs) -> torch.Tensor:
        return F.softplus(self.logit_scale(inputs.query_BTD))

    def _attention_scores(self, inputs: HeadInputs) -> torch.Tensor:
        """Attention of each prompt query to the objects of the prompt, scores (B, T, H, L)."""
        query_BTHD = self.prompt_query(inputs.query_BTD).unflatten(-1, (self.num_prompt_queries, -1))
        scores_BTHL = query_BTHD @ self.prompt_key(inputs.prompt.masked_BLD)[:, None].mT
        scores_BTHL = scores_BTHL * inputs.query_BTD.shape[-1] ** -0.5
        return mask_scores(scores_BTHL, inputs.prompt.object_mask_BL[:, None, None])


def sum_losses(
    losses: dict[str, torch.Tensor], metrics: dict[str, torch.Tensor]
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Sum named losses; they join the metrics as `loss/<name>`."""
    named = {f"loss/{name}": loss.detach() for name, loss in losses.items()}
    return torch.stack(list(losses.values())).sum(), {**metrics, **named}
