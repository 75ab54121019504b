"""Place candidates: objects in view, at the first step and in the prompt, and grid points of the table.

They are concatenated in this order; only those in view differ from step to step.

Shape suffixes as in `inputs.py`; C candidates, G geometric features, X any features.
"""

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from openvima.policies.nn.actions import ActionTargets, at
from openvima.policies.pointer.inputs import OFFSET_UNIT_M, HeadInputs, ObjectSet
from openvima.scene.explanation import PLACE_KINDS

NUM_GEOMETRY = 6
# A candidate this near to the demonstrated place is right. Boxes of rotated objects have their centres up to
# 36 mm from where the old centre goes; in 300 demonstrations nothing else was within 50 mm of a place that
# something was carried to.
COPIED_WITHIN_M = 0.04
_SAME_PLACE_M = 0.03  # scale of the "same place" feature
_NEIGHBOURHOOD_M = 0.1  # scale of the "neighbour" features
_GRID_X_MM, _GRID_Y_MM = (300, 700, 4), (-420, 420, 8)  # first and last line of the grid, and how many


class GridCandidates(nn.Module):
    """Points of a grid on the table, each with a learned token: places where nothing is or was."""

    points_mm: torch.Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        lines = (np.linspace(*line) for line in (_GRID_X_MM, _GRID_Y_MM))
        points = np.stack(np.meshgrid(*lines), axis=-1).reshape(-1, 2).round().astype(np.int64)
        # A constant has a device of its own, so that a network on the meta device has it, too; integers
        # survive half precision.
        self.register_buffer("points_mm", torch.tensor(points, device="cpu"), persistent=False)
        self.tokens = nn.Parameter(torch.randn(len(points), width) * 0.1)

    def forward(self, like: ObjectSet) -> ObjectSet:
        """Return them for every episode of a batch of object sets."""
        batch, count = len(like.masks_BK), len(self.points_mm)
        index_BK = torch.zeros(batch, count, dtype=torch.int64, device=self.points_mm.device)
        points_K2 = self.points_mm.to(like.positions_BK2.dtype) / 1000
        return ObjectSet(
            self.tokens.expand(batch, -1, -1),
            torch.ones_like(index_BK, dtype=torch.bool),
            like.appearance_BKA.new_zeros(batch, count, like.appearance_BKA.shape[-1]),
            points_K2.expand(batch, -1, -1),
            index_BK,
            like.rotations_BKR.new_zeros(batch, count, like.rotations_BKR.shape[-1]),
        )


class PlaceCandidates:
    """All candidates of a batch.

    Args:
        inputs: Knows the objects in view, at the first step and in prompt images.
        grid: Grid points.

    Attributes:
        masks_BTC: Which candidates exist.
        positions_BTC2: Their positions, metres.
        kinds_C: Where each comes from, as an index of `PLACE_KINDS`, int64.
        tokens_BKD, appearance_BKA, image_index_BK: Of those that are the same at every step.
    """

    def __init__(self, inputs: HeadInputs, grid: ObjectSet) -> None:
        self.inputs, self.sets = inputs, (inputs.first_step, inputs.prompt.objects, grid)
        self.tokens_BKD, self.appearance_BKA, self.image_index_BK, masks_BK, positions_BK2 = (
            torch.cat([getattr(part, name) for part in self.sets], dim=1)
            for name in ("tokens_BKD", "appearance_BKA", "image_index_BK", "masks_BK", "positions_BK2")
        )
        masks_BTN, num_steps = inputs.masks_BTN, inputs.masks_BTN.shape[1]
        masks_BTK = masks_BK[:, None].expand(-1, num_steps, -1)
        self.masks_BTC = torch.cat([masks_BTN, masks_BTK], dim=2)
        positions_BTK2 = positions_BK2[:, None].expand(-1, num_steps, -1, -1)
        self.positions_BTC2 = torch.cat([inputs.positions_BTN2, positions_BTK2], dim=2)
        counts = (masks_BTN.shape[2], *(part.masks_BK.shape[1] for part in self.sets))
        kinds = [kind for kind, count in enumerate(counts) for _ in range(count)]
        self.kinds_C = torch.tensor(kinds, device=masks_BTN.device)

    def tokens_at(self, place_BT: torch.Tensor) -> torch.Tensor:
        """Token of one candidate at every step, (B, T, D)."""
        num_in_view = self.inputs.masks_BTN.shape[-1]
        index_BT1 = (place_BT - num_in_view).clamp(min=0)[..., None]
        kept_BTD = self.tokens_BKD.gather(1, index_BT1.expand(-1, -1, self.tokens_BKD.shape[-1]))
        now_BTD = at(self.inputs.objects_BTND, place_BT.clamp(max=num_in_view - 1))
        return torch.where((place_BT < num_in_view)[..., None], now_BTD, kept_BTD)

    def keys(self, layers: nn.ModuleList) -> torch.Tensor:
        """Keys of those that are the same at every step, (B, K, D), each kind through its own layer."""
        parts = zip(layers[1:], self.sets, strict=True)
        return torch.cat([layer(part.tokens_BKD) for layer, part in parts], dim=1)

    def geometry(self, pick_BT: torch.Tensor) -> torch.Tensor:
        """Geometric features, (B, T, C, G).

        x, y and distance relative to the picked object, and whether it is there; whether another object in
        view is near, and whether an object of the prompt is.
        """
        inputs, prompt, positions_BTC2 = self.inputs, self.inputs.prompt.objects, self.positions_BTC2
        relative_BTC2 = positions_BTC2 - at(inputs.positions_BTN2, pick_BT)[:, :, None]
        distance_BTC1 = relative_BTC2.norm(dim=-1, keepdim=True)
        same_BTC1 = torch.exp(-(distance_BTC1 / _SAME_PLACE_M).square())
        others_BTN = inputs.masks_BTN & ~F.one_hot(pick_BT, inputs.masks_BTN.shape[-1]).bool()
        near = [
            proximity(distances(positions_BTC2, inputs.positions_BTN2), others_BTN[:, :, None]),
            proximity(
                distances(positions_BTC2, prompt.positions_BK2[:, None]), prompt.masks_BK[:, None, None]
            ),
        ]
        scaled = (relative_BTC2 / OFFSET_UNIT_M, distance_BTC1 / OFFSET_UNIT_M)
        return torch.cat([*scaled, same_BTC1, *near], dim=-1)

    def right(self, targets: ActionTargets, goal_BT2: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Determine which candidates are right.

        Where the demonstration names an object, that one is, and so are candidates at the demonstrated place
        that are nearer to it than to another object in view: the middle of a container's box may be farther
        from what was put into it than another object is. Where it names none, candidates at the place are,
        and without any the nearest point of the grid.

        Args:
            targets: Demonstrated actions.
            goal_BT2: Where the centre of the picked object goes, metres.

        Returns:
            Which candidates are right, (B, T, C), at least one; and whether that follows from what is known,
            (B, T): a grid point is one of many that would do.
        """
        masks_BTC, is_grid_C = self.masks_BTC, self.kinds_C == PLACE_KINDS.index("grid")
        is_named_BT = targets.place_BT >= 0
        distance_BTC = (self.positions_BTC2 - goal_BT2[:, :, None]).norm(dim=-1)
        count = masks_BTC.shape[-1]
        near_BTC = (distance_BTC < COPIED_WITHIN_M) & masks_BTC & ~is_grid_C
        near_BTC &= ~is_named_BT[..., None] | self._nearest_to(targets.place_BT)
        nearest_BT = distance_BTC.masked_fill(~is_grid_C, torch.inf).argmin(-1)
        instead_BT = torch.where(is_named_BT, targets.place_BT, nearest_BT)
        is_copied_BT = near_BTC.any(-1)
        needs_instead_BT = is_named_BT | ~is_copied_BT
        right_BTC = near_BTC | (F.one_hot(instead_BT, count).bool() & needs_instead_BT[..., None])
        return right_BTC, is_copied_BT | is_named_BT

    def _nearest_to(self, slot_BT: torch.Tensor) -> torch.Tensor:
        """Whether each candidate is nearer to an object in view than to all others in view, (B, T, C)."""
        inputs = self.inputs
        distance_BTCN = distances(self.positions_BTC2, inputs.positions_BTN2)
        distance_BTCN = distance_BTCN.masked_fill(~inputs.masks_BTN[:, :, None], torch.inf)
        return distance_BTCN.argmin(-1) == slot_BT[..., None]


def products(query_BTX: torch.Tensor, now_BTNX: torch.Tensor, kept_BKX: torch.Tensor) -> torch.Tensor:
    """Dot products of a query with all candidates, (B, T, C)."""
    now_BTN = (now_BTNX @ query_BTX[..., None]).squeeze(-1)
    return torch.cat([now_BTN, query_BTX @ kept_BKX.mT], dim=2)


def distances(positions_BTC2: torch.Tensor, others_BTK2: torch.Tensor) -> torch.Tensor:
    """Distances between positions, (B, T, C, K), metres; T may be 1."""
    return (positions_BTC2[:, :, :, None] - others_BTK2[:, :, None]).norm(dim=-1)


def proximity(
    distance_BTCK: torch.Tensor, masks_BTCK: torch.Tensor, unit_m: float = _NEIGHBOURHOOD_M
) -> torch.Tensor:
    """How near the nearest other position is, (B, T, C, 1): 1 at the same place, 0 far away.

    Args:
        distance_BTCK: Distances, metres.
        masks_BTCK: Which of them count; B, T and C may be 1.
        unit_m: Scale of the distance.
    """
    near_BTCK = torch.exp(distance_BTCK.square() * -(unit_m**-2)) * masks_BTCK
    return F.pad(near_BTCK, (0, 1)).amax(dim=-1, keepdim=True)  # there may be none
