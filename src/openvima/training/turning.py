"""Learning looks and turns at once, from scenes that are laid twice."""

import math
from dataclasses import replace

import torch
from torch.nn import functional as F

from openvima.policies.nn.object_encoder import ObjectEncoder
from openvima.training.pretrain import Again, Pairs, alike_in_prompts, colour_mixing, contrast

TURN_TOLERANCE_RAD = math.radians(15)  # as in `rotate` and `twist`
_CROP_PX = 32


def joint_loss(
    encoder: ObjectEncoder, pairs: Pairs, *, temperature: float, generator: torch.Generator
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Loss of matching objects in a scene with prompt images and with the scene laid again, and of turns.

    Args:
        encoder: Gets the gradient. Without turn bins only looks count.
        pairs: A batch of scenes laid twice.
        temperature: Divisor of the similarities.
        generator: Draws how the colours of the batch are mixed.

    Returns:
        The loss, and the shares of objects matched within the batch and of turns that are right.
    """
    again = _again(pairs)
    mixing = colour_mixing(generator).to(pairs.scene_crops.device)
    crops = torch.stack([pairs.prompt_crops, pairs.scene_crops, again.crops])
    crops = torch.einsum("cd,skvdyx->skvcyx", mixing, crops.to(mixing.dtype))
    features = encoder.encode_images(crops).transpose(1, 2)
    masks = torch.stack([pairs.prompt_masks, pairs.scene_masks, again.masks]).transpose(1, 2)
    prompt, scene, moved = encoder.embed_appearance(features, masks)
    rows = again.masks.any(dim=1)
    same_look = pairs.looks[rows, None] == pairs.looks[None, rows]
    alone_loss, alone = contrast(prompt, scene, alike_in_prompts(pairs), temperature=temperature)
    again_loss, matched = contrast(moved[rows], scene[rows], same_look, temperature=temperature)
    loss = (alone_loss + again_loss) / 2
    metrics = {
        "loss/contrastive": alone_loss.detach(),
        "loss/second_view": again_loss.detach(),
        "contrastive_accuracy": alone,
        "second_view_accuracy": matched,
    }
    if encoder.config.rotation_bins:
        rotation_loss = turn_loss(encoder, features, masks, again.turns)
        loss, metrics["loss/rotation"] = loss + rotation_loss, rotation_loss.detach()
        metrics["rotation_accuracy"] = _right_turns(encoder, features, masks, again.turns).float().mean()
    return loss, metrics


def turn_loss(
    encoder: ObjectEncoder, features_3VKF: torch.Tensor, masks_3VK: torch.Tensor, turns_K2: torch.Tensor
) -> torch.Tensor:
    """Cross-entropy of the turns between any two of three images, over the objects that show theirs.

    A turn between two bins belongs to both, to the nearer one more.

    Args:
        encoder: One with turn bins.
        features_3VKF: Crop features in the prompt image, in the scene, and in the scene laid again.
        masks_3VK: Whether the object is visible there, shape (3, 2, K).
        turns_K2: Turns from each image to the next, in radians; NaN where objects do not show theirs.
    """
    first_turn, second_turn = turns_K2.unbind(1)
    losses = []
    for a, b, turns in ((0, 1, first_turn), (1, 2, second_turn), (0, 2, first_turn + second_turn)):
        scores_KR, turns = _compared(encoder, features_3VKF[[a, b]], masks_3VK[[a, b]], turns)
        bins = scores_KR.shape[-1]
        place = turns * (bins / (2 * math.pi))
        low = place.floor()
        share = (place - low).to(scores_KR.dtype)
        of_low = F.nll_loss(scores_KR, low.long() % bins, reduction="none")
        of_high = F.nll_loss(scores_KR, (low.long() + 1) % bins, reduction="none")
        losses.append((1 - share) * of_low + share * of_high)
    return torch.cat(losses).sum() / max(1, sum(map(len, losses)))


@torch.no_grad()
def turn_accuracy(encoder: ObjectEncoder, pairs: Pairs, *, chunk: int = 256) -> float:
    """Share of objects laid again whose likeliest turn is right within 15 degrees; NaN if none shows it."""
    right = []
    for rows in torch.arange(len(pairs.looks), device=pairs.looks.device).split(chunk):
        part = pairs.select(rows)
        again = _again(part)
        features = encoder.encode_images(torch.stack([part.scene_crops, again.crops])).transpose(1, 2)
        masks = torch.stack([part.scene_masks, again.masks]).transpose(1, 2)
        right.append(_right_turns(encoder, features, masks, again.turns))
    return float(torch.cat(right).double().mean())


@torch.no_grad()
def _right_turns(
    encoder: ObjectEncoder, features: torch.Tensor, masks: torch.Tensor, turns_K2: torch.Tensor
) -> torch.Tensor:
    """Whether the turn between the last two images is right, for objects that show it; (at most K,), bool."""
    scores_KR, turns = _compared(encoder, features[-2:], masks[-2:], turns_K2[:, 1])
    likeliest = scores_KR.argmax(dim=-1) * (2 * math.pi / scores_KR.shape[-1])
    error = torch.remainder(likeliest - turns + math.pi, 2 * math.pi) - math.pi
    return error.abs() <= TURN_TOLERANCE_RAD


def _compared(
    encoder: ObjectEncoder, features_2VKF: torch.Tensor, masks_2VK: torch.Tensor, turns_K: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Scores and true turns of the objects that show theirs and are visible in one view of both images."""
    is_seen = (masks_2VK[0] & masks_2VK[1]).any(dim=0)
    rows = torch.nonzero(is_seen & ~turns_K.isnan())[:, 0]
    (first, second), (seen, seen_again) = features_2VKF[:, :, rows], masks_2VK[:, :, rows]
    return encoder.rotation(first, second, seen, seen_again), turns_K[rows]


def _again(pairs: Pairs) -> Again:
    assert pairs.again is not None, "scenes were laid once"
    return pairs.again


def mirrored(pairs: Pairs, generator: torch.Generator) -> Pairs:
    """Exchange left and right in all images of half of the objects, drawn at random; turns are then reversed.

    Both cameras look at the table from its middle, so that mirrored images are images of mirrored objects.
    """
    again = _again(pairs)
    is_mirrored = (torch.rand(len(pairs.looks), generator=generator) < 0.5).to(pairs.looks.device)

    def flipped(crops: torch.Tensor) -> torch.Tensor:
        return torch.where(is_mirrored[:, None, None, None, None], crops.flip(-1), crops)

    turns = torch.where(is_mirrored[:, None], -again.turns, again.turns)
    return replace(
        pairs,
        prompt_crops=flipped(pairs.prompt_crops),
        scene_crops=flipped(pairs.scene_crops),
        again=Again(flipped(again.crops), again.masks, turns),
    )


def shifted(pairs: Pairs, pixels: float, generator: torch.Generator) -> Pairs:
    """Cut each crop a little beside its box, or a little larger or smaller, as a detector does.

    Args:
        pairs: Their crops become float32.
        pixels: Largest shift of a crop, and half of the largest change of its size, in its own pixels.
        generator: Draws the shifts.
    """
    again = pairs.again
    return replace(
        pairs,
        prompt_crops=_shifted(pairs.prompt_crops, pixels, generator),
        scene_crops=_shifted(pairs.scene_crops, pixels, generator),
        again=replace(again, crops=_shifted(again.crops, pixels, generator)) if again else None,
    )


def _shifted(crops: torch.Tensor, pixels: float, generator: torch.Generator) -> torch.Tensor:
    flat = crops.flatten(0, -4).float()
    draws = (2 * torch.rand(len(flat), 3, generator=generator) - 1).to(flat.device)
    draws *= 2 * pixels / _CROP_PX  # the borders lie at −1 and 1
    theta = flat.new_zeros(len(flat), 2, 3)
    theta[:, 0, 0] = theta[:, 1, 1] = 1 + draws[:, 0]
    theta[:, :, 2] = draws[:, 1:]
    grid = F.affine_grid(theta, list(flat.shape), align_corners=False)
    return F.grid_sample(flat, grid, padding_mode="border", align_corners=False).unflatten(
        0, crops.shape[:-3]
    )
