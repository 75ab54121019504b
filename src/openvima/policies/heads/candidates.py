"""Candidates for a place: objects in view, at the first step and in the prompt, and free points of the table.

They stand in this order, those of one kind after each other; only those in view differ from step to step.

Shape suffixes as in `base.py`; C candidates, G features of how they lie, X any features.
"""

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.heads.base import ActionTargets, HeadInputs, Recollection, Remembered
from openvima.policies.heads.pointing import OFFSET_UNIT_M, at

KINDS = ("in view", "at first", "in the prompt", "free")  # where candidates come from
NUM_GEOMETRY = 6
# A candidate this near to the demonstrated place is right. Boxes of turned objects have their centres up to
# 36 mm from where the old centre goes; in 300 demonstrations nothing else lay within 50 mm of a place that
# something was carried to.
COPIED_WITHIN_M = 0.04
_HERE_M = 0.03  # a candidate this near to the picked object is, more or less, where that is
_BESIDE_M = 0.1  # objects that are this near to a candidate are beside it
_FREE_X_MM, _FREE_Y_MM = (300, 700, 4), (-420, 420, 8)  # first and last line of the points, and how many


class FreePoints(nn.Module):
    """Points of a grid on the table, each with a learned token."""

    points_mm: torch.Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        lines = (np.linspace(*line) for line in (_FREE_X_MM, _FREE_Y_MM))
        points = np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2).round().astype(np.int64)
        # A constant has a device of its own, so that a network without weights has it, too; whole numbers
        # stay what they are in half precision.
        self.register_buffer("points_mm", torch.tensor(points, device="cpu"), persistent=False)
        self.tokens = nn.Parameter(torch.randn(len(points), width) * 0.1)

    def forward(self, like: Remembered) -> Remembered:
        """Return them for every episode of a batch of memories."""
        batch, count = len(like.masks_BK), len(self.points_mm)
        numbers_BK = torch.zeros(batch, count, dtype=torch.int64, device=self.points_mm.device)
        points_K2 = self.points_mm.to(like.positions_BK2.dtype) / 1000
        return Remembered(
            self.tokens.expand(batch, -1, -1),
            torch.ones_like(numbers_BK, dtype=torch.bool),
            like.appearance_BKA.new_zeros(batch, count, like.appearance_BKA.shape[-1]),
            points_K2.expand(batch, -1, -1),
            numbers_BK,
        )


def candidate_masks(inputs: HeadInputs) -> torch.Tensor:
    """Which candidates exist, shape (B, T, C)."""
    masks_BTK = torch.cat([part.masks_BK for part in recollection_of(inputs).parts], dim=1)[:, None]
    return torch.cat([inputs.masks_BTN, masks_BTK.expand(-1, inputs.masks_BTN.shape[1], -1)], dim=2)


def candidate_positions(inputs: HeadInputs) -> torch.Tensor:
    """Where they lie, shape (B, T, C, 2), metres."""
    kept_BTK2 = torch.cat([part.positions_BK2 for part in recollection_of(inputs).parts], dim=1)[:, None]
    return torch.cat([inputs.positions_BTN2, kept_BTK2.expand(-1, inputs.masks_BTN.shape[1], -1, -1)], dim=2)


def positions_at(inputs: HeadInputs, place_BT: torch.Tensor) -> torch.Tensor:
    """Where the chosen candidate lies, (B, T, 2), metres."""
    return at(candidate_positions(inputs), place_BT)


def right_candidates(
    inputs: HeadInputs, targets: ActionTargets, goal_BT2: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tell which candidates are right.

    Args:
        inputs: What is known, with the free points.
        targets: What the demonstrator did.
        goal_BT2: Where the centre of the picked object goes, metres.

    Returns:
        Which candidates are right, (B, T, C), at least one; and whether that follows from what is known,
        (B, T): a free point is one of many that would do.
    """
    kept = recollection_of(inputs)
    assert kept.free is not None  # the head has added them
    exist_BTC, num_free = candidate_masks(inputs), kept.free.masks_BK.shape[1]
    distance_BTC = (candidate_positions(inputs) - goal_BT2[:, :, None]).norm(dim=-1)
    is_free_C = torch.arange(exist_BTC.shape[-1], device=exist_BTC.device) >= exist_BTC.shape[-1] - num_free
    near_BTC = (distance_BTC < COPIED_WITHIN_M) & exist_BTC & ~is_free_C
    nearest_BT = distance_BTC.masked_fill(~is_free_C, torch.inf).argmin(-1)
    named_BT = torch.where(targets.place_BT >= 0, targets.place_BT, nearest_BT)
    named_BTC = F.one_hot(named_BT, exist_BTC.shape[-1]).bool()
    is_copied_BT = near_BTC.any(-1)
    right_BTC = torch.where(is_copied_BT[..., None], near_BTC, named_BTC)
    return right_BTC, is_copied_BT | (targets.place_BT >= 0)


def tokens_of_remembered(layers: nn.ModuleList, kept: Recollection) -> torch.Tensor:
    """What is known of the remembered candidates, (B, K, D), each kind through its own layer."""
    parts = zip(layers[1:], kept.parts, strict=False)  # there may be no free points
    return torch.cat([layer(part.tokens_BKD) for layer, part in parts], dim=1)


def kinds_of(inputs: HeadInputs) -> torch.Tensor:
    """Where each candidate comes from, as a number of `KINDS`, shape (C,), int64."""
    kept = [part.masks_BK.shape[1] for part in recollection_of(inputs).parts]
    counts = torch.tensor([inputs.masks_BTN.shape[2], *kept])
    return torch.arange(len(counts)).repeat_interleave(counts).to(inputs.masks_BTN.device)


def geometry_of(inputs: HeadInputs, pick_BT: torch.Tensor) -> torch.Tensor:
    """How candidates lie, (B, T, C, G).

    It is x, y and distance from the picked object, and whether they are there; whether another object in view
    is near, and whether a place of the prompt is.
    """
    places_BTC2, scenes = candidate_positions(inputs), recollection_of(inputs).scenes
    apart_BTC2 = places_BTC2 - at(inputs.positions_BTN2, pick_BT)[:, :, None]
    distance_BTC1 = apart_BTC2.norm(dim=-1, keepdim=True)
    here_BTC1 = torch.exp(-(distance_BTC1 / _HERE_M).square())
    others_BTN = inputs.masks_BTN & ~F.one_hot(pick_BT, inputs.masks_BTN.shape[-1]).bool()
    near = [
        beside(places_BTC2, inputs.positions_BTN2, others_BTN[:, :, None]),
        beside(places_BTC2, scenes.positions_BK2[:, None], scenes.masks_BK[:, None, None]),
    ]
    return torch.cat([apart_BTC2 / OFFSET_UNIT_M, distance_BTC1 / OFFSET_UNIT_M, here_BTC1, *near], dim=-1)


def products(query_BTX: torch.Tensor, now_BTNX: torch.Tensor, kept_BKX: torch.Tensor) -> torch.Tensor:
    """Products of a vector at each step with those of the candidates, (B, T, C)."""
    now_BTN = (now_BTNX @ query_BTX[..., None]).squeeze(-1)
    return torch.cat([now_BTN, query_BTX @ kept_BKX.mT], dim=2)


def token_at(inputs: HeadInputs, place_BT: torch.Tensor) -> torch.Tensor:
    """What is known of the chosen candidate, (B, T, D)."""
    num_in_view = inputs.masks_BTN.shape[-1]
    kept_BKD = torch.cat([part.tokens_BKD for part in recollection_of(inputs).parts], dim=1)
    index_BTD = (place_BT - num_in_view).clamp(min=0)[..., None].expand(-1, -1, kept_BKD.shape[-1])
    now_BTD = at(inputs.objects_BTND, place_BT.clamp(max=num_in_view - 1))
    return torch.where((place_BT < num_in_view)[..., None], now_BTD, kept_BKD.gather(1, index_BTD))


def recollection_of(inputs: HeadInputs) -> Recollection:
    """What may be copied; the network gives it to heads that copy."""
    assert inputs.recollection is not None
    return inputs.recollection


def beside(
    places_BTC2: torch.Tensor,
    others_BTK2: torch.Tensor,
    masks_BTCK: torch.Tensor,
    unit_m: float = _BESIDE_M,
) -> torch.Tensor:
    """How near other places are to each one, (B, T, C, 1): 1 for the same place, 0 for none near.

    Args:
        places_BTC2: Places, metres.
        others_BTK2: Other places, metres; here and below T may be 1.
        masks_BTCK: Which of them count for which place; C may be 1.
        unit_m: What is farther away than this is not near.
    """
    apart_BTCK = (places_BTC2[:, :, :, None] - others_BTK2[:, :, None]).norm(dim=-1)
    near_BTCK = torch.exp(-(apart_BTCK / unit_m).square()) * masks_BTCK
    return F.pad(near_BTCK, (0, 1)).amax(dim=-1, keepdim=True)  # there may be none
