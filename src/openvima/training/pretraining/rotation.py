"""Loss and accuracy of estimating the relative rotation of objects.

Shape suffixes: V views, K objects, F features, R rotation bins; a leading 2 or 3 counts images.
"""

import math

import torch
from torch.nn import functional as F

from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.training.pretraining.pairs import Pairs

TOLERANCE_RAD = math.radians(15)  # as in `rotate` and `twist`


def rotation_loss(
    encoder: ObjectEncoder, features_3VKF: torch.Tensor, masks_3VK: torch.Tensor, rotations_K2: torch.Tensor
) -> torch.Tensor:
    """Cross-entropy of the rotations between any two of three images, with linear weights of adjacent bins.

    Args:
        encoder: One with rotation bins.
        features_3VKF: Crop features in the prompt image, the scene, and the second view.
        masks_3VK: Whether the object is visible there, shape (3, 2, K).
        rotations_K2: Rotations from each image to the next, in radians; NaN is ignored.
    """
    first, second = rotations_K2.unbind(1)
    losses = []
    for a, b, rotations in ((0, 1, first), (1, 2, second), (0, 2, first + second)):
        scores_KR, rotations = _compared(encoder, features_3VKF[[a, b]], masks_3VK[[a, b]], rotations)
        bins = scores_KR.shape[-1]
        position = rotations * (bins / (2 * math.pi))
        low = position.floor()
        weight = (position - low).to(scores_KR.dtype)
        of_low = F.nll_loss(scores_KR, low.long() % bins, reduction="none")
        of_high = F.nll_loss(scores_KR, (low.long() + 1) % bins, reduction="none")
        losses.append((1 - weight) * of_low + weight * of_high)
    return torch.cat(losses).sum() / max(1, sum(map(len, losses)))


@torch.no_grad()
def rotation_accuracy(encoder: ObjectEncoder, pairs: Pairs, *, chunk: int = 256) -> float:
    """Fraction of rotations to the second view estimated within 15 degrees; NaN if there is none."""
    is_correct = []
    for rows in torch.arange(len(pairs.scenes), device=pairs.scenes.device).split(chunk):
        part = pairs.select(rows)
        view = part.second_view
        assert view is not None
        features = encoder.encode_images(torch.stack([part.scene_crops, view.crops])).transpose(1, 2)
        masks = torch.stack([part.scene_masks, view.masks]).transpose(1, 2)
        is_correct.append(is_rotation_correct(encoder, features, masks, view.rotations))
    return float(torch.cat(is_correct).double().mean())


@torch.no_grad()
def is_rotation_correct(
    encoder: ObjectEncoder, features: torch.Tensor, masks: torch.Tensor, rotations_K2: torch.Tensor
) -> torch.Tensor:
    """Return whether the rotation between the last two images is within tolerance; (at most K,), bool."""
    scores_KR, rotations = _compared(encoder, features[-2:], masks[-2:], rotations_K2[:, 1])
    estimates = scores_KR.argmax(dim=-1) * (2 * math.pi / scores_KR.shape[-1])
    error = torch.remainder(estimates - rotations + math.pi, 2 * math.pi) - math.pi
    return error.abs() <= TOLERANCE_RAD


def _compared(
    encoder: ObjectEncoder, features_2VKF: torch.Tensor, masks_2VK: torch.Tensor, rotations_K: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return scores and true rotations of objects that have one and share a view in both images."""
    is_seen = (masks_2VK[0] & masks_2VK[1]).any(dim=0)
    rows = torch.nonzero(is_seen & ~rotations_K.isnan())[:, 0]
    (first, second), (seen, seen_again) = features_2VKF[:, :, rows], masks_2VK[:, :, rows]
    return encoder.rotation(first, second, seen, seen_again), rotations_K[rows]
