"""Planar pick-and-place geometry of the pointing heads, their losses on it and their metrics.

Shape suffixes as in `inputs.py`.
"""

import math

import torch
from torch.nn import functional as F

from openvima.policies.nn.actions import from_unit_range, masked_mean, to_unit_range

OFFSET_UNIT_M = 0.1  # offsets are predicted in decimetres, so that they are of the order of 1
RIGHT_OFFSET_M = 0.02  # a place this near to the demonstrated one counts as right in the metrics


def pick_and_place(grasp_BT2: torch.Tensor, place_BT2: torch.Tensor, yaw_BT: torch.Tensor) -> torch.Tensor:
    """Actions (B, T, 12), within bounds, that pick and place at points in metres, rotating by radians."""
    zero, one = torch.zeros_like(yaw_BT), torch.ones_like(yaw_BT)
    pose0 = [grasp_BT2, torch.stack([zero, zero, zero, one], dim=-1)]
    half = yaw_BT / 2
    pose1 = [place_BT2, torch.stack([zero, zero, torch.sin(half), torch.cos(half)], dim=-1)]
    return from_unit_range(to_unit_range(torch.cat(pose0 + pose1, dim=-1)))


def relative_yaw(actions_BTC: torch.Tensor) -> torch.Tensor:
    """Yaw of pose1 relative to pose0 in radians, shape (B, T)."""
    yaws = []
    for start in (2, 8):
        x, y, z, w = actions_BTC[..., start : start + 4].unbind(-1)
        yaws.append(torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    return yaws[1] - yaws[0]


def carried_to(actions_BTC: torch.Tensor, grasp_BT2: torch.Tensor) -> torch.Tensor:
    """Where a point of an object ends when the object moves as demonstrated.

    The demonstrator may hold an object by another point than the policy would. The object moves rigidly, so
    that place' = place + rotation · (grasp' − grasp).

    Args:
        actions_BTC: The demonstrated actions.
        grasp_BT2: Points of the objects, metres.

    Returns:
        Their places, shape (B, T, 2), metres.
    """
    held_BT2 = grasp_BT2 - actions_BTC[..., 0:2]
    return actions_BTC[..., 6:8] + rotated(held_BT2, relative_yaw(actions_BTC))


def rotated(vectors_BT2: torch.Tensor, yaw_BT: torch.Tensor) -> torch.Tensor:
    """Rotate vectors on the table by angles in radians, counter-clockwise seen from above."""
    x, y = vectors_BT2.unbind(-1)
    cosine, sine = torch.cos(yaw_BT), torch.sin(yaw_BT)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)


def yaw_to_bin(yaw: torch.Tensor, num_bins: int) -> torch.Tensor:
    """Nearest of `num_bins` equal steps around the circle, int64."""
    return torch.round(yaw / (2 * math.pi / num_bins)).to(torch.int64) % num_bins


def bin_to_yaw(bins: torch.Tensor, num_bins: int, dtype: torch.dtype) -> torch.Tensor:
    """Angle of a bin in radians."""
    return bins.to(dtype) * (2 * math.pi / num_bins)


def offset_loss(offset_BT2: torch.Tensor, true_offset_BT2: torch.Tensor) -> torch.Tensor:
    """Huber loss of offsets in metres, (B, T)."""
    scaled = (offset_BT2 / OFFSET_UNIT_M, true_offset_BT2 / OFFSET_UNIT_M)
    return F.smooth_l1_loss(*scaled, reduction="none", beta=0.1).sum(-1)


@torch.no_grad()
def pointing_metrics(
    logits: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    targets: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    error_BT2: torch.Tensor,
    has_pick_BT: torch.Tensor,
    has_place_BT: torch.Tensor,
) -> dict[str, torch.Tensor]:
    """Accuracies, and the mean error of the offset.

    Args:
        logits: Of pick, place and yaw, (B, T, classes) each.
        targets: The right classes, (B, T) each.
        error_BT2: Error of the offset, metres.
        has_pick_BT: At which steps the object to pick is known.
        has_place_BT: At which of these the place is known, too.
    """
    (pick_logits, place_logits, yaw_logits), (pick, place, yaw) = logits, targets
    error_BT = error_BT2.norm(dim=-1)
    is_right_BT = (pick_logits.argmax(-1) == pick) & (place_logits.argmax(-1) == place)
    is_right_BT &= error_BT < RIGHT_OFFSET_M
    return {
        "accuracy": masked_mean(is_right_BT.to(error_BT2.dtype), has_place_BT),
        "pick_accuracy": accuracy(pick_logits, pick, has_pick_BT),
        "place_accuracy": accuracy(place_logits, place, has_place_BT),
        "yaw_accuracy": accuracy(yaw_logits, yaw, has_place_BT),
        "offset_error_m": masked_mean(error_BT, has_place_BT),
    }


def accuracy(logits_BTN: torch.Tensor, target_BT: torch.Tensor, mask_BT: torch.Tensor) -> torch.Tensor:
    """Fraction of the steps at which the right class has the highest logit."""
    return masked_mean((logits_BTN.argmax(-1) == target_BT).to(logits_BTN.dtype), mask_BT)
