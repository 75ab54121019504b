"""What the heads of the pointer models read, and how their actions are composed.

Shape suffixes: B batch, T steps, N objects in view, L positions of the prompt, K objects of a set, D width, A
width of appearance, P attributes, X width of all their projections, C components of an action, R bins of
rotations.
"""

import math
from dataclasses import dataclass

import torch
from torch.nn import functional as F

from openvima.policies.nn.actions import ActionTargets, at, carry, from_unit_range, masked_mean, to_unit_range
from openvima.policies.nn.layers import TensorRecord
from openvima.policies.pointer.correspondence import ObjectFeatures


@dataclass(frozen=True, slots=True, eq=False)
class ObjectSet(TensorRecord):
    """Objects that were seen before, each at its position then.

    Args:
        tokens_BKD: Their tokens.
        masks_BK: Which of them exist and have a position on the table.
        appearance_BKA: Their appearance.
        positions_BK2: Table points under their boxes, metres; in float32 at least.
        image_index_BK: For objects of a prompt: which of its scenes shows each, from 0 in reading order.
        rotations_BKR: Probabilities of the rotation of each since an earlier image, counter-clockwise; R is 0
            if they are not estimated.
    """

    tokens_BKD: torch.Tensor
    masks_BK: torch.Tensor
    appearance_BKA: torch.Tensor
    positions_BK2: torch.Tensor
    image_index_BK: torch.Tensor
    rotations_BKR: torch.Tensor

    @staticmethod
    def of(tokens_BKD: torch.Tensor, objects: ObjectFeatures, rotations_BKR: torch.Tensor) -> "ObjectSet":
        """Combine tokens with what is known of their objects."""
        return ObjectSet(
            tokens_BKD,
            objects.exists_N & objects.in_scene_N,
            objects.appearance_NA,
            objects.positions_N2,
            objects.image_index_N,
            rotations_BKR,
        )


@dataclass(frozen=True, slots=True, eq=False)
class PointerPrompt(TensorRecord):
    """Encoded prompts; constant within an episode.

    Args:
        tokens_BLD: Encoded words and images, for the decoder.
        masked_BLD: The same, encoded with appearance masked: neither crops nor names of textures, so that
            textures cannot be memorised as role cues.
        mask_BL: Which positions exist.
        object_mask_BL: Which of them are images, or words that refer to one.
        appearance_BLA: Appearance of their objects; zero elsewhere.
        text_appearance_BLA: Appearance that words describe; zero for other words.
        features: Objects of the images, shapes (B, M, ...).
        objects: The same as place candidates.
        selected_BP: Which attributes the prompt asks to compare; None without attributes.
        attributes_BLX: Projections of the objects of images, whose dot products are similarities in the
            selected attributes; zero elsewhere.
        describes_BL: Which words describe appearance; None if none does.
    """

    tokens_BLD: torch.Tensor
    masked_BLD: torch.Tensor
    mask_BL: torch.Tensor
    object_mask_BL: torch.Tensor
    appearance_BLA: torch.Tensor
    text_appearance_BLA: torch.Tensor
    features: ObjectFeatures
    objects: ObjectSet
    selected_BP: torch.Tensor | None = None
    attributes_BLX: torch.Tensor | None = None
    describes_BL: torch.Tensor | None = None


@dataclass(frozen=True, slots=True, eq=False)
class HeadInputs:
    """What is known at each step.

    Args:
        query_BTD: Output of the decoder at the action query.
        objects_BTND: Output of the decoder at the objects in view.
        masks_BTN: Which of these exist.
        appearance_BTNA: Appearance of the objects in view.
        positions_BTN2: Table points under the objects' boxes, metres; in float32 at least.
        grasps_BTN2: Table points under the objects' most interior pixels, metres; in float32 at least.
        has_suction_BT: Whether the end effector is the suction cup, which carries an object rigidly; the
            spatula pushes.
        previous_BTC: The action before each step, metres and quaternions; zero where there was none.
        steps_BT: Indices of the steps, from 0; (1, T), those of all episodes.
        first_step: Objects in view at the first step of the episode.
        prompt: Encoded prompts.
        rotations_BTNR: Probabilities of the rotation that brings each object in view to the heading in which
            the prompt shows it, counter-clockwise; zero for those it does not show; R is 0 if rotations are
            not estimated.
        attributes_BTNX: Projections of the objects in view, as `PointerPrompt.attributes_BLX`; None where no
            prompt selects any.
    """

    query_BTD: torch.Tensor
    objects_BTND: torch.Tensor
    masks_BTN: torch.Tensor
    appearance_BTNA: torch.Tensor
    positions_BTN2: torch.Tensor
    grasps_BTN2: torch.Tensor
    has_suction_BT: torch.Tensor
    previous_BTC: torch.Tensor
    steps_BT: torch.Tensor
    first_step: ObjectSet
    prompt: PointerPrompt
    rotations_BTNR: torch.Tensor
    attributes_BTNX: torch.Tensor | None = None


OFFSET_UNIT_M = 0.1  # offsets are predicted in decimetres, so that they are of the order of 1
RIGHT_OFFSET_M = 0.02  # a place this near to the demonstrated one counts as right in the metrics


def pick_and_place(grasp_BT2: torch.Tensor, place_BT2: torch.Tensor, yaw_BT: torch.Tensor) -> torch.Tensor:
    """Actions (B, T, 12), within bounds, that pick and place at points in metres, rotating by radians."""
    zero, one = torch.zeros_like(yaw_BT), torch.ones_like(yaw_BT)
    pose0 = [grasp_BT2, torch.stack([zero, zero, zero, one], dim=-1)]
    half = yaw_BT / 2
    pose1 = [place_BT2, torch.stack([zero, zero, torch.sin(half), torch.cos(half)], dim=-1)]
    return from_unit_range(to_unit_range(torch.cat(pose0 + pose1, dim=-1)))


def yaw_to_bin(yaw: torch.Tensor, num_bins: int) -> torch.Tensor:
    """Nearest of `num_bins` equal steps around the circle, int64."""
    return torch.round(yaw / (2 * math.pi / num_bins)).to(torch.int64) % num_bins


def bin_to_yaw(bins: torch.Tensor, num_bins: int, dtype: torch.dtype) -> torch.Tensor:
    """Angle of a bin in radians."""
    return bins.to(dtype) * (2 * math.pi / num_bins)


def demonstrated_place(
    inputs: HeadInputs, targets: ActionTargets, points_BTN2: torch.Tensor, pick_BT: torch.Tensor
) -> torch.Tensor:
    """Where a point of the picked object goes, or the tool that pushes it, (B, T, 2), metres."""
    carried_BT2 = carry(targets.actions_BTC, at(points_BTN2, pick_BT))
    return torch.where(inputs.has_suction_BT[..., None], carried_BT2, targets.actions_BTC[..., 6:8])


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
