"""Actions as vectors, their planar geometry, encoder and targets, and how a class is decoded from logits.

Shape suffixes: B batch, T steps, N objects in view, C components of an action, X any width.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import torch
from torch import nn

from openvima.policies.nn.layers import TensorRecord, layer_of, mlp
from openvima.scene import WORKSPACE_HIGH, WORKSPACE_LOW

# Slices of the action vector: positions and quaternions of both poses, in this order in all policies.
ACTION_PARTS = {
    "pose0_position": slice(0, 2),
    "pose0_rotation": slice(2, 6),
    "pose1_position": slice(6, 8),
    "pose1_rotation": slice(8, 12),
}
ACTION_WIDTH = 12


class ActionEncoder(nn.Module):
    """A past action -> one token: an MLP for each of its four parts, then a linear layer."""

    def __init__(self, part_width: int, width: int) -> None:
        super().__init__()
        sizes = [part.stop - part.start for part in ACTION_PARTS.values()]
        self.parts = nn.ModuleList(mlp((size, part_width, part_width)) for size in sizes)
        self.out = nn.Linear(len(sizes) * part_width, width)

    @torch.no_grad()
    def align(self) -> None:
        """Let fresh tokens differ about as much between actions as those of images do between objects.

        The first layers read `4 · (action - 0.5)`, as those of boxes do.
        """
        for layers in self.parts:
            first = layer_of(layers, 0)
            first.weight.mul_(4)
            first.bias.sub_(first.weight.sum(dim=1) / 2)
        self.out.weight.mul_((self.out.in_features / len(self.parts)) ** 0.5 / 2)

    def forward(self, unit_actions: torch.Tensor) -> torch.Tensor:
        """Map actions in unit range, shape (..., 12), to tokens (..., D)."""
        slices = ACTION_PARTS.values()
        parts = [layers(unit_actions[..., part]) for layers, part in zip(self.parts, slices, strict=True)]
        return self.out(torch.cat(parts, dim=-1))


def at(values_BTNX: torch.Tensor, slot_BT: torch.Tensor) -> torch.Tensor:
    """Take the row of one slot at every step: (B, T, N, X) and (B, T) give (B, T, X)."""
    index = slot_BT[..., None, None].expand(*slot_BT.shape, 1, values_BTNX.shape[-1])
    return values_BTNX.gather(2, index).squeeze(2)


def mask_scores(scores: torch.Tensor, exists: torch.Tensor) -> torch.Tensor:
    """Give what does not exist the most negative finite score."""
    return torch.where(exists, scores, torch.finfo(scores.dtype).min)


# Decoding strategy: logits (B, ..., classes) to class indices (B, ...).
DecodingStrategy = Callable[[torch.Tensor], torch.Tensor]

PICK_NEAR_M, PLACE_NEAR_M, ROTATION_NEAR_RAD = 0.02, 0.04, math.radians(15)

# Of position and quaternion of one pose.
_LOW = (*WORKSPACE_LOW, -1.0, -1.0, -1.0, -1.0)
_HIGH = (*WORKSPACE_HIGH, 1.0, 1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ActionTargets(TensorRecord):
    """Demonstrated actions.

    Args:
        actions_BTC: Actions to learn, in metres and quaternions, in the order of `ACTION_PARTS`.
        pick_BT: Slot of the picked object in view; -1 where it is not in view.
        place_BT: Slot of the object relative to which it was placed; -1 where there is none.
        steps_BT: Which steps exist.
    """

    actions_BTC: torch.Tensor
    pick_BT: torch.Tensor
    place_BT: torch.Tensor
    steps_BT: torch.Tensor


def greedy(logits: torch.Tensor) -> torch.Tensor:
    """Decode the class with the highest logit, the first one of equals."""
    return logits.argmax(-1)


def sampling(generators: Sequence[torch.Generator], temperature: float) -> DecodingStrategy:
    """Make the decoding strategy that samples classes.

    Args:
        generators: One for each row of the logits. A sample takes one number of it, whatever the number of
            classes, so that padding changes nothing.
        temperature: Divisor of the logits.
    """

    def sample(logits: torch.Tensor) -> torch.Tensor:
        probabilities = torch.softmax(logits.to("cpu", torch.float64) / temperature, dim=-1)
        cumulative = probabilities.cumsum(dim=-1)
        shape = (*logits.shape[1:-1], 1)
        drawn = [torch.rand(shape, dtype=torch.float64, generator=generator) for generator in generators]
        sampled = torch.searchsorted(cumulative, torch.stack(drawn) * cumulative[..., -1:], right=True)
        return sampled.squeeze(-1).clamp(max=logits.shape[-1] - 1).to(logits.device)

    return sample


def to_unit_range(actions: torch.Tensor) -> torch.Tensor:
    """Map actions (..., 12) from metres and quaternion components to 0 … 1."""
    low, high = _bounds(actions.dtype, actions.device)
    return (actions - low) / (high - low)


def from_unit_range(values: torch.Tensor) -> torch.Tensor:
    """Undo `to_unit_range`; values outside 0 … 1 are clipped to the bounds."""
    low, high = _bounds(values.dtype, values.device)
    return torch.minimum(torch.maximum(low + values * (high - low), low), high)


def masked_mean(values: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Mean of the values where the mask is true; 0 where it is true nowhere."""
    weights = mask.to(values.dtype)
    return (values * weights).sum() / weights.sum().clamp(min=1)


def yaw_between(actions: torch.Tensor) -> torch.Tensor:
    """Return the rotation from pick to place, radians in (−2π, 2π), of actions (..., 12)."""
    x, y, z, w = actions.unflatten(-1, (2, 6))[..., 2:].unbind(-1)
    yaws = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return yaws[..., 1] - yaws[..., 0]


def carry(actions_BTC: torch.Tensor, grasp_BT2: torch.Tensor) -> torch.Tensor:
    """Where a point of an object ends when the object moves as demonstrated.

    The demonstrator may hold an object by another point than the policy would. The object moves rigidly, so
    that place' = place + rotation · (grasp' − grasp).

    Args:
        actions_BTC: The demonstrated actions.
        grasp_BT2: Points of the objects, metres.

    Returns:
        Their places, shape (B, T, 2), metres.
    """
    held_BT2 = grasp_BT2 - actions_BTC[..., ACTION_PARTS["pose0_position"]]
    return actions_BTC[..., ACTION_PARTS["pose1_position"]] + rotate(held_BT2, yaw_between(actions_BTC))


def rotate(vectors_BT2: torch.Tensor, yaw_BT: torch.Tensor) -> torch.Tensor:
    """Rotate vectors on the table by angles in radians, counter-clockwise seen from above."""
    x, y = vectors_BT2.unbind(-1)
    cosine, sine = torch.cos(yaw_BT), torch.sin(yaw_BT)
    return torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)


@torch.no_grad()
def action_metrics(
    actions_BTC: torch.Tensor, targets: ActionTargets, points_BTN2: torch.Tensor, exist_BTN: torch.Tensor
) -> dict[str, torch.Tensor]:
    """Compare actions with the demonstrated ones, as fractions of the steps.

    Args:
        actions_BTC: Decoded actions, metres and quaternions.
        targets: The demonstrated actions.
        points_BTN2: Where objects can be grasped, metres.
        exist_BTN: Which objects are in view; with whole frames none is.

    Returns:
        "pick_accuracy", within 2 cm; "object_accuracy", the object nearest to the pick is the right one;
        "place_accuracy", within 4 cm; "rotation_accuracy", within 15°; "accuracy", all but the object.
    """
    dtype, wanted_BTC = actions_BTC.dtype, targets.actions_BTC.to(actions_BTC.dtype)
    pick, place = ACTION_PARTS["pose0_position"], ACTION_PARTS["pose1_position"]
    turn_BT = yaw_between(actions_BTC) - yaw_between(wanted_BTC)
    is_right_BT = {
        "pick": (actions_BTC - wanted_BTC)[..., pick].norm(dim=-1) <= PICK_NEAR_M,
        "place": (actions_BTC - wanted_BTC)[..., place].norm(dim=-1) <= PLACE_NEAR_M,
        "rotation": turn_BT.cos() >= math.cos(ROTATION_NEAR_RAD),
    }
    is_all_BT = torch.stack(list(is_right_BT.values())).all(0)
    metrics = {"accuracy": masked_mean(is_all_BT.to(dtype), targets.steps_BT)}
    if exist_BTN.any():
        nearest = [
            (points_BTN2.to(dtype) - each[:, :, None, pick])
            .norm(dim=-1)
            .masked_fill(~exist_BTN, math.inf)
            .argmin(-1)
            for each in (actions_BTC, wanted_BTC)
        ]
        is_right_BT["object"] = nearest[0] == nearest[1]
    for name, each_BT in is_right_BT.items():
        metrics[f"{name}_accuracy"] = masked_mean(each_BT.to(dtype), targets.steps_BT)
    return metrics


def nll(logits_BTN: torch.Tensor, target_BT: torch.Tensor) -> torch.Tensor:
    """Negative log-likelihood of a class at every step, shape (B, T)."""
    loss = torch.nn.functional.cross_entropy(logits_BTN.flatten(0, 1), target_BT.flatten(), reduction="none")
    return loss.view_as(target_BT)


@cache
def _bounds(dtype: torch.dtype, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    with torch.inference_mode(False):  # so that those first used in acting serve for training, too
        low, high = torch.tensor((_LOW * 2, _HIGH * 2), dtype=dtype, device=device)
        return low, high
